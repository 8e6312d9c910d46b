"""The real machine of the daemon's tests: the twin as a process, the daemon and the guard beside it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fdhil import config as machine_config
from fdhil.cli.demo.processes import Process, Twin
from fdhil.cli.main import cli, run_safely
from fdhil.commissioning.record import save_record
from fdhil.commissioning.steps import commission
from fdhil.config import MachineConfig
from fdhil.daemon.control import ask
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
    "drivers.can.sdo.RESPONSE_TIMEOUT_S": 20.0,
    "drivers.can.sdo.DEADLINE_S": 20.0,
    "commissioning.survey.LISTEN_S": 0.3,
    "commissioning.steps.SETTLE_CYCLES": 100,
    "commissioning.steps.AVERAGE_CYCLES": 60,
}


@contextmanager
def patient() -> Iterator[None]:
    """Wait long for a drive's answer by SDO, but not for a simulated drive to settle as a real one does."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in WAITS.items():
            patch.setattr(f"fdhil.{name}", value)
        yield


@dataclass
class Shop:
    """A twin that runs, and the configuration of the machine that it is."""

    folder: Path
    twin: Twin
    path: Path
    config: MachineConfig

    @property
    def run_directory(self) -> Path:
        """The folder of sockets and token."""
        assert self.config.store.run_directory is not None
        return self.config.store.run_directory

    def commission(self) -> None:
        """Commission both axes; a twin on a busy host may take seconds for an answer."""
        with patient():
            for axis in self.config.axis:
                save_record(commission(self.config, axis), self.config.store.directory)

    def daemon(self) -> Process:
        """Start a daemon and wait until it listens."""
        daemon = Process("daemon", ["fdhil", "run", str(self.path)], self.folder / "daemon.log")
        self.wait(lambda: self.status() is not None, daemon)
        self.status_when(lambda s: s["source"]["state"] == "listening")
        return daemon

    def guard(self) -> Process:
        """Start a guard and wait until it answers."""
        guard = Process("guard", ["fdhil.cli.guard", str(self.path)], self.folder / "guard.log")
        self.wait((self.run_directory / "guard.sock").exists, guard)
        return guard

    def wait(self, done: Any, process: Process | None = None) -> None:
        """Wait until ``done()``, or a process has ended."""
        while not done():
            self.twin.check()
            if process is not None:
                process.check()
            time.sleep(0.05)

    def status(self) -> dict[str, Any] | None:
        """Return the daemon's status, None while none runs."""
        try:
            return ask(self.run_directory / "daemon.sock", {"request": "status"}, timeout_s=500.0)
        except ConnectError:
            return None

    def status_when(self, ready: Any) -> dict[str, Any]:
        """Return the first status for which ``ready`` holds."""
        found: dict[str, Any] = {}

        def done() -> bool:
            found.update(self.status() or {})
            return bool(found and ready(found))

        self.wait(done)
        return found

    def told(self, words: str, times: int = 1) -> None:
        """Wait until the daemon's log has said so for the n-th time, and what it told of is over."""
        log = self.folder / "daemon.log"
        self.wait(lambda: log.read_text().count(words) >= times)
        self.status_when(lambda s: s["state"] == "OFF" and s["armed"] is None)

    def nc(self, on: bool) -> None:
        """Switch the NC: with it come SYNC, NMT and enabled drives."""
        self.twin.command("nc", on=on)
        self.twin.event("nc")

    def play(self, name: str, program: str, **options: Any) -> dict[str, Any]:
        """Write a program and let the NC play it."""
        path = self.folder / name
        path.write_text(program)
        return self.twin.play(path, **options)


@contextmanager
def opened(folder: Path, bench: str = BENCH) -> Iterator[Shop]:
    """Start a twin whose tables are heavier than the data sheet says; ``bench`` is the text of its configuration."""
    (folder / "twin.toml").write_text(f'{bench}[bus.can0]\ninterface = "socketcand"\n')
    with Twin(folder / "twin.toml", folder / "twin.log") as twin:
        bus = twin.ready["buses"]["can0"]
        machine = folder / "machine.toml"
        place = f'channel = "{bus["channel"]}"\nhost = "{bus["host"]}"\nport = {bus["port"]}\n'
        machine.write_text(f'{bench}[bus.can0]\ninterface = "socketcand"\n{place}')
        yield Shop(folder, twin, machine, machine_config.load(machine))


def fdhil(*arguments: str | Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    """Run the command line as its entry point does, in this process; return exit code, stdout and stderr."""
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["fdhil", *map(str, arguments)])
        code = run_safely(cli)
    said = capsys.readouterr()
    return code, said.out, said.err
