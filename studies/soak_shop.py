"""The processes of a shop that runs for long: machine, guard, daemon, pages and a publisher, each to be restarted."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil import config as machine_config
from fdhil.cli.demo.machines import load_machine_document
from fdhil.cli.demo.processes import ChildProcess, SimulatorProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.commissioning.commissioning_record import save_record
from fdhil.commissioning.commissioning_steps import commission_axis
from fdhil.config import MachineConfig
from fdhil.daemon.daemon_socket import SOCKET_NAME, ask_daemon
from fdhil.errors import ConnectError, FdhilError
from tests.free_ports import find_free_port

PATIENCE_S = 600.0
LOOK_S = 0.1
TRIES = 50
CANNOT = "cannot be played"
KEPT_WINDOWS = 400
STORE_MB = 512


def make_config(folder: Path, period_s: float, lockstep: bool) -> dict[str, Any]:
    """Return the configuration: the demonstration's two axes, with a store of its own and all ports chosen."""
    document = load_machine_document()
    document["machine"]["sync_period_s"] = period_s
    document["sim"]["pace"] = "lockstep" if lockstep else "realtime"
    document["guard"]["clock"] = "sync" if lockstep else "monotonic"
    document["store"] = {
        "directory": str(folder / "store" / "data"),
        "run_directory": str(folder / "run"),
        "keep_windows": KEPT_WINDOWS,
    }
    document["bus"] = {"can0": {"interface": "socketcand", "host": "127.0.0.1", "port": find_free_port()}}
    document["publish"] = {"prometheus": {"port": find_free_port()}}
    for axis in document["axis"].values():
        axis["voltage"] = {"host": "127.0.0.1", "port": find_free_port()}  # of the drive; a thermometer is beside it
        axis["temperature"] = {**axis["voltage"], "period_s": 1.0}
    return document


@dataclass
class MachineRig:
    """All processes of one machine below ``folder``, whose store begins as ``filled`` is.

    ``restarts`` counts who ended by itself and was started again.
    """

    folder: Path
    document: dict[str, Any]
    filled: Path | None = None
    config: MachineConfig = field(init=False)
    twin: SimulatorProcess = field(init=False)
    processes: dict[str, ChildProcess] = field(default_factory=dict)
    url: str = ""
    restarts: dict[str, int] = field(default_factory=dict)
    mounted: bool = False

    @property
    def file(self) -> Path:
        """The machine's configuration."""
        return self.folder / "machine.toml"

    @property
    def store(self) -> Path:
        """The folder that the daemon writes to."""
        return self.folder / "store" / "data"

    @property
    def logs(self) -> Path:
        """The folder of the processes' own words."""
        return self.folder / "logs"

    def list_pids(self) -> Mapping[str, int]:
        """Return the process of each part of fdhil, and the simulated machine's."""
        return {name: process.pid for name, process in self.processes.items()} | {"machine": self.twin.pid}

    # -- starting and ending

    def open(self) -> None:
        """Start everything, commissioned, with the NC on."""
        for path in (self.folder / "store", self.logs):
            path.mkdir(parents=True, exist_ok=True)
        self._mount()
        if self.filled is None:
            self.store.mkdir(parents=True, exist_ok=True)
        else:
            shutil.copytree(self.filled, self.store)
        self.start_simulator()
        for axis in self.config.axis:
            save_record(commission_axis(self.config, axis), self.store, self.config.store.commissioning_key)
        for name in ("guard", "daemon", "pages", "publisher"):
            self.start(name)
        self.switch_nc(on=True)

    def _mount(self) -> None:
        """Have a small disk of its own below the store, which can be full; only root may."""
        if os.getuid() == 0:
            command = ["mount", "-t", "tmpfs", "-o", f"size={STORE_MB}m", "fdhil-soak", str(self.folder / "store")]
            self.mounted = subprocess.run(command, check=False, capture_output=True).returncode == 0

    def start_simulator(self) -> None:
        """Switch the machine on; it has the ports that it had before."""
        self.file.write_text(format_toml(self.document), "utf-8")
        self.config = machine_config.load_config(self.file)
        self.twin = SimulatorProcess(self.file, self.logs / "machine.log")

    def start(self, name: str) -> None:
        """Start one of fdhil's processes and wait until it answers."""
        config = str(self.file)
        command = {
            "guard": ["fdhil.cli.guard", config],
            "daemon": ["fdhil", "run", config],
            "pages": ["fdhil", "web", config, "--port", "0", "--json"],
            "publisher": ["fdhil", "publish", "prometheus", config],
        }[name]
        self.processes[name] = process = ChildProcess(name, command, self.logs / f"{name}.log")
        if name == "pages":
            self.url = process.await_event("ready")["url"]
        elif name == "daemon":
            self.wait(lambda: self.query_status() is not None, "the daemon answers", process)
        elif name == "publisher":
            port = self.document["publish"]["prometheus"]["port"]
            self.wait(lambda: _listens(port), "the publisher listens", process)
        elif name == "guard":
            guard_socket = self.config.guard_directory / "guard.sock"
            self.wait(lambda: guard_socket.exists(), "the guard's socket is there", process)

    def restart_ended(self) -> None:
        """Restart processes that have ended, as systemd would, and count them."""
        for name, process in list(self.processes.items()):
            try:
                process.check_running()
            except ConnectError:
                process.stop()
                self.restarts[name] = self.restarts.get(name, 0) + 1
                self.start(name)

    def restart(self, name: str, number: int = signal.SIGTERM) -> None:
        """End one of fdhil's processes by a signal and start it again."""
        process = self.processes[name]
        os.kill(process.pid, number)
        self.wait(lambda: _ended(process), f"{name} ends")
        process.stop()
        self.start(name)

    def power_cycle(self) -> None:
        """Switch the machine off and on again: bus, drives, sensors and NC are gone meanwhile."""
        self.twin.stop()
        time.sleep(1.0)
        self.end_guard_without_bus()
        self.start_simulator()
        self.restart_ended()
        self.wait(lambda: self.read_status_part("source").get("state") == "listening", "the daemon listens again")
        self.compare_drives()

    def end_guard_without_bus(self) -> None:
        """Let the guard end, which cannot be without a bus; one that waits with an offset is started again as well."""
        guard = self.processes.pop("guard")
        until_s = time.monotonic() + 10.0
        while not _ended(guard) and time.monotonic() < until_s:
            time.sleep(LOOK_S)
        guard.stop()
        self._guard_waits = True

    _guard_waits: bool = False

    def compare_drives(self) -> None:
        """Have the drives compared with their commissioned state (they booted), then release them to the NC."""
        if self._guard_waits:
            self.start("guard")
            self._guard_waits = False
        self.switch_nc(on=False)
        self.run_command("check", fine=(0, 1, 3))
        self.switch_nc(on=True)

    def close(self) -> None:
        """End everything; the measurements stay."""
        for process in (*self.processes.values(), self.twin):
            process.stop()
        if self.mounted:
            subprocess.run(["umount", str(self.folder / "store")], check=False)

    # -- talking to it

    def run_command(self, *arguments: object, fine: tuple[int, ...] = (0,)) -> dict[str, Any]:
        """Run a command of fdhil that answers in JSON."""
        command = ["python", "-m", "fdhil", str(arguments[0]), str(self.file), *map(str, arguments[1:]), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
        if done.returncode not in fine:
            raise FdhilError(f"{' '.join(command)} ended with {done.returncode}: {done.stdout}{done.stderr}")
        return dict(json.loads(done.stdout)) if done.stdout else {}

    def query_daemon(self, request: str, **more: Any) -> dict[str, Any]:
        """Send a request to the daemon."""
        return dict(ask_daemon(self.folder / "run" / SOCKET_NAME, {"request": request, **more}, timeout_s=PATIENCE_S))

    def query_status(self) -> dict[str, Any] | None:
        """Return the daemon's status, None while it does not answer."""
        try:
            return self.query_daemon("status")
        except FdhilError:
            return None

    def read_status_part(self, key: str) -> Any:
        """Return a part of the daemon's status, empty while there is none."""
        return (self.query_status() or {}).get(key) or {}

    def wait(self, done: Callable[[], bool], what: str, process: ChildProcess | None = None) -> None:
        """Wait for a condition; FdhilError after ten minutes, or if a process has ended."""
        until_s = time.monotonic() + PATIENCE_S
        while not done():
            (process or self.twin).check_running()
            if time.monotonic() > until_s:
                raise FdhilError(f"waited in vain: {what}; see {self.logs}")
            time.sleep(LOOK_S)

    def switch_nc(self, on: bool) -> None:
        """Switch the NC on or off, trying again while a drive is not ready for it."""
        for _ in range(TRIES):
            self.twin.send_command("nc", on=on)
            if (reported := self.read_event("nc")) and reported["on"] is on:
                return
            time.sleep(LOOK_S)
        raise FdhilError(f"the NC of the simulated machine does not get {'the drives' if on else 'out'}")

    def start_fault(self, name: str, **keys: Any) -> None:
        """Start a fault of the simulated machine."""
        self.twin.send_command("fault", fault=name, **keys)

    def read_event(self, kind: str) -> dict[str, Any] | None:
        """Return the machine's next event of a kind, None where it cannot; its other complaints are of the faults."""
        while True:
            try:
                return self.twin.await_event(kind)
            except ConnectError as error:
                self.twin.check_running()
                if CANNOT in str(error):
                    return None

    def play_program(self, program: Path, meanwhile: Callable[[], None] = lambda: None) -> bool:
        """Let the NC play a program; return whether no fault stopped it. An NC that has lost a drive is switched on."""
        self.twin.send_command("play", file=str(program))
        meanwhile()
        finished = self.read_event("finished")
        if finished is None:
            self.switch_nc(on=True)
            self.twin.send_command("play", file=str(program))
            finished = self.read_event("finished")
        return finished is not None and not finished["stopped"]


def _listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
        return True
    return False


def _ended(process: ChildProcess) -> bool:
    with suppress(ConnectError):
        process.check_running()
        return False
    return True
