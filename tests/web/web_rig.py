"""The processes of the browser tests: simulator, guard, daemon and ``fdhil web``, with weeks of history.

The simulator is the machine of that history, so that a program can be armed at once. It runs in real time, slower on a
busy host; fdhil counts SYNC.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from fdhil import config as machine_config
from fdhil.arming.operator_token import read_token
from fdhil.cli.demo.processes import ChildProcess, SimulatorProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.commissioning.commissioning_record import save_record
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.config import MachineConfig
from fdhil.daemon.daemon_socket import ask_daemon
from fdhil.errors import ConnectError
from fdhil.guard.guard_step import SETTLED_CYCLES
from fdhil.program import compute_program_digest, load_trajectory
from fdhil.store.history_database import History
from tests.bench import bench_document
from tests.daemon.machine_rig import patient
from tests.web import stored_weeks
from tests.web.silent_process import SilentProcess

PERIOD_S = 0.002  # half the work of 1 kHz: the browser needs the other half
PASSWORDS = {"watcher": "watcher's own password", "operator": "operator's own password"}
ROLES = {"watcher": "watch", "operator": "operate"}
PROGRAMS = "programs"
CORNER = "G21 G90 G94\nG4 P0.3\nG1 X60 F8000\nG1 Y40\nG4 P0.2\nM2\n"
SHUTTLE = "G21 G90 G94\nG0 X200 Y200\nG4 P0.3\nG0 X0 Y0\nG4 P0.3\nM2\n"
MEANWHILE_S = 0.05


@dataclass
class WebRig:
    folder: Path
    config_path: Path
    config: MachineConfig
    twin: SimulatorProcess
    processes: dict[str, ChildProcess | SilentProcess] = field(default_factory=dict)
    url: str = ""

    @property
    def program(self) -> Path:
        return self.folder / PROGRAMS / "corner.ngc"

    def _start_process(self, name: str, *arguments: str) -> None:
        self.processes[name] = SilentProcess(name, [*arguments, str(self.config_path)], self.folder / f"{name}.log")

    def start_guard(self) -> None:
        self._start_process("guard", "fdhil.cli.guard")
        self.wait_for((self.config.guard_directory / "guard.sock").exists)

    def start_daemon(self) -> None:
        self._start_process("daemon", "fdhil", "run")
        self.wait_for(lambda: self.read_status() is not None)
        self.wait_for_status(lambda told: told["source"]["state"] == "listening")

    def start_web(self) -> None:
        web = ChildProcess("web", ["fdhil", "web", "--json", str(self.config_path)], self.folder / "web.log")
        self.processes["web"] = web
        self.url = str(web.await_event("ready")["url"]).rstrip("/")

    def send_request(self, path: str, body: bytes | None = None, token: str = "") -> Any:
        headers = {"Content-Type": "application/json", "X-Fdhil": "1", "Authorization": f"Bearer {token}"}
        with urlopen(Request(self.url + path, body, headers), timeout=500.0) as answer:
            return json.load(answer)

    def log_in_for_token(self, user: str) -> str:
        login = {"name": user, "password": PASSWORDS[user]}
        return str(self.send_request("/api/session", json.dumps(login).encode())["token"])

    def forecast_program(self, token: str) -> str:
        dropped = self.send_request(f"/api/program?name={self.program.name}", self.program.read_bytes(), token)
        path = f"/api/program/{dropped['digest']}"
        self.wait_for(lambda: self.send_request(path, None, token)["state"] == "done")
        return str(dropped["digest"])

    def run_rapid(self, accepted: bool) -> str:
        with History.open_read_only(self.config.store.directory) as history:
            number = next(window.number for window in history.read_windows("X") if window.accepted == accepted)
        return f"/rapids/X/{number}"

    def list_paths(self, token: str) -> dict[str, str]:
        return {
            "machine": "/machine",
            "axis": "/machine/X",
            "live": "/live",
            "rapids": "/rapids",
            "rapid": self.run_rapid(accepted=True),
            "refused": self.run_rapid(accepted=False),
            "history": "/history/X",
            "program": "/program",
            "forecast": f"/program/{self.forecast_program(token)}?line=4",
            "events": "/events",
            "panel": "/panel",
        }

    def stop(self, name: str) -> int:
        return self.processes.pop(name).stop()

    def wait_for(self, done: Callable[[], object]) -> None:
        while not done():
            for process in (self.twin, *self.processes.values()):
                process.check_running()
            time.sleep(MEANWHILE_S)

    def read_status(self) -> dict[str, Any] | None:
        try:
            return ask_daemon(self.config.run_directory / "daemon.sock", {"request": "status"}, timeout_s=500.0)
        except ConnectError:
            return None

    def wait_for_status(self, ready: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def done() -> bool:
            found.clear()
            found.update(self.read_status() or {})
            return bool(found and ready(found))

        self.wait_for(done)
        return found

    def wait_until_settled(self) -> None:
        self.wait_for_status(lambda told: told["guard"].get("good_for", 0) > SETTLED_CYCLES)

    def arm_program(self) -> None:
        self.wait_until_settled()
        request = {"request": "arm", "program": str(self.program), "method": None}
        token = read_token(self.config.run_directory)
        answer = ask_daemon(self.config.run_directory / "daemon.sock", {**request, "token": token}, timeout_s=500.0)
        assert answer["ok"], answer

    def send_nc_command(self, on: bool) -> None:
        self.twin.send_command("nc", on=on)
        self.twin.await_event("nc")

    def play_program(self, program: Path) -> None:
        self.twin.play_program(program)


def read_document() -> dict[str, Any]:
    found = bench_document()
    found["machine"] |= {"name": "bench mill", "sync_period_s": PERIOD_S}
    sim = {"pace": "realtime", "thermal": {"rise_c": 0.5}}
    return found | {
        "bus": {"can0": {"interface": "socketcand"}},
        "guard": {"clock": "sync"},
        "correction": {"learning": True},
        "sim": sim,
    }


@contextmanager
def open_rig(folder: Path, rapids: int = 84, acting: bool = True) -> Iterator[WebRig]:
    asked = read_document()
    (folder / "twin.toml").write_text(format_toml(asked), "utf-8")
    with SimulatorProcess(folder / "twin.toml", folder / "twin.log") as twin:
        path = folder / "machine.toml"
        path.write_text(format_toml(_join_settings(asked, twin, acting)), "utf-8")
        stage = WebRig(folder, path, machine_config.load_config(path), twin)
        try:
            _prepare_machine(stage, rapids)
            stage.start_guard()
            stage.start_daemon()
            stage.send_nc_command(on=True)
            stage.start_web()
            yield stage
        finally:
            for process in reversed(stage.processes.values()):
                process.stop()


def _join_settings(asked: dict[str, Any], twin: SimulatorProcess, acting: bool) -> dict[str, Any]:
    bus = {key: value for key, value in twin.ready["buses"]["can0"].items() if value is not None}
    sensors = {axis: {"temperature": {**place, "period_s": 0.5}} for axis, place in twin.ready["modbus"].items()}
    axes = {name: {**axis, **sensors.get(name, {})} for name, axis in asked["axis"].items()}
    web = {"port": 0, "acting": acting, "users_file": "users.json", "programs_directory": PROGRAMS}
    return asked | {"bus": {"can0": bus}, "axis": axes, "web": web}


def _prepare_machine(stage: WebRig, rapids: int) -> None:
    with patient():
        for axis in stage.config.axis:
            save_record(commission_axis(stage.config, axis), stage.config.store.directory)
    stage.program.parent.mkdir()
    stage.program.write_text(CORNER, "ascii")
    stored_weeks.fill_store(stage.config, rapids)
    rows = load_trajectory(stage.program, stage.config).time_s.size
    stored_weeks.write_learned_offsets(stage.config, compute_program_digest(stage.program), rows)
    for name, role in ROLES.items():
        command = [sys.executable, "-m", "fdhil", "web-user", str(stage.config_path), name, "--role", role]
        subprocess.run(command, input=f"{PASSWORDS[name]}\n", text=True, check=True, capture_output=True)
