"""The real processes for daemon tests: the simulator, the daemon and the guard."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.processes import ChildProcess, SimulatorProcess
from fdhil.cli.main import cli, run_safely
from fdhil.commissioning.commissioning_record import save_record
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.config import MachineConfig
from fdhil.daemon.daemon_socket import ask_daemon
from fdhil.errors import ConnectError
from tests.bench import axis_toml

REAL = {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.085, "ft": 0.05, "Cd": 5.0}
TO_AND_FRO = "G0 X200 Y200\nG4 P0.3\nG0 X0 Y0\nG4 P0.3\n"
SHUTTLE = "G21 G90 G94\n" + TO_AND_FRO * 2 + "M2\n"
CORNER = "G21 G90 G94\nG4 P0.3\nG1 X60 F8000\nG1 Y40\nG4 P0.2\nM2\n"
HEAD = """
[machine]
name = "bench"
[guard]
clock = "sync"
[sim]
pace = "lockstep"
"""
AXIS = axis_toml("X") + "[sim.axis.X]\nJt = 0.085\n"
BENCH = HEAD + AXIS + AXIS.replace(".X", ".Y")


WAITS = {
    "drivers.can.sdo_channel.RESPONSE_TIMEOUT_S": 20.0,
    "drivers.can.sdo_channel.DEADLINE_S": 20.0,
    "commissioning.drive_survey.LISTEN_S": 0.3,
    "commissioning.commissioning_steps.SETTLE_CYCLES": 100,
    "commissioning.commissioning_steps.AVERAGE_CYCLES": 60,
}


@contextmanager
def patient() -> Iterator[None]:
    """Allow long SDO timeouts, but no settling time as of a real drive."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in WAITS.items():
            patch.setattr(f"fdhil.{name}", value)
        yield


@dataclass
class MachineRig:
    folder: Path
    twin: SimulatorProcess
    path: Path
    config: MachineConfig

    @property
    def run_directory(self) -> Path:
        assert self.config.store.run_directory is not None
        return self.config.store.run_directory

    def commission(self) -> None:
        with patient():
            for axis in self.config.axis:
                save_record(commission_axis(self.config, axis), self.config.store.directory)

    def daemon(self) -> ChildProcess:
        daemon = ChildProcess("daemon", ["fdhil", "run", str(self.path)], self.folder / "daemon.log")
        self.wait(lambda: self.status() is not None, daemon)
        self.wait_for_status(lambda s: s["source"]["state"] == "listening")
        return daemon

    def guard(self) -> ChildProcess:
        guard = ChildProcess("guard", ["fdhil.cli.guard", str(self.path)], self.folder / "guard.log")
        self.wait((self.run_directory / "guard.sock").exists, guard)
        return guard

    def wait(self, done: Any, process: ChildProcess | None = None) -> None:
        while not done():
            self.twin.check_running()
            if process is not None:
                process.check_running()
            time.sleep(0.05)

    def status(self) -> dict[str, Any] | None:
        try:
            return ask_daemon(self.run_directory / "daemon.sock", {"request": "status"}, timeout_s=500.0)
        except ConnectError:
            return None

    def wait_for_status(self, ready: Any) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def done() -> bool:
            found.update(self.status() or {})
            return bool(found and ready(found))

        self.wait(done)
        return found

    def get_notices(self, words: str, times: int = 1) -> None:
        log = self.folder / "daemon.log"
        self.wait(lambda: log.read_text().count(words) >= times)
        self.wait_for_status(lambda s: s["state"] == "OFF" and s["armed"] is None)

    def nc(self, on: bool) -> None:
        self.twin.send_command("nc", on=on)
        self.twin.await_event("nc")

    def play(self, name: str, program: str, **options: Any) -> dict[str, Any]:
        path = self.folder / name
        path.write_text(program)
        return self.twin.play_program(path, **options)


@contextmanager
def opened(folder: Path, bench: str = BENCH) -> Iterator[MachineRig]:
    (folder / "twin.toml").write_text(f'{bench}[bus.can0]\ninterface = "socketcand"\n')
    with SimulatorProcess(folder / "twin.toml", folder / "twin.log") as twin:
        bus = twin.ready["buses"]["can0"]
        machine = folder / "machine.toml"
        place = f'channel = "{bus["channel"]}"\nhost = "{bus["host"]}"\nport = {bus["port"]}\n'
        machine.write_text(f'{bench}[bus.can0]\ninterface = "socketcand"\n{place}')
        yield MachineRig(folder, twin, machine, machine_config.load_config(machine))


def fdhil(*arguments: str | Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["fdhil", *map(str, arguments)])
        code = run_safely(cli)
    output = capsys.readouterr()
    return code, output.out, output.err
