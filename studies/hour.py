"""An hour, measured: from an empty folder to a corrected cut beside LinuxCNC (``python -m studies.hour``).

Plays the retrofitter on the simulated drives with the commands that he types: install (with ``--install``), init with
answers, doctor, check, commission with test rapids, daemon and guard, LinuxCNC, rapids, record, correct, arm, cut.
Prints the minutes of each step, and all that he had to know, with where it stands. Needs Debian's ``linuxcnc-uspace``.
Only the computer's time is measured: looking values up, wiring and reading are not.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil import config as machine_config
from fdhil.bridges import linuxcnc as bridge
from fdhil.child_process import interrupt_on_stop_signals, wrap_to_end_with_parent
from fdhil.cli.demo.machines import load_machine_document
from fdhil.cli.demo.processes import ChildProcess
from fdhil.cli.demo.toml_writer import format_toml
from fdhil.daemon.daemon_socket import SOCKET_NAME
from fdhil.program import load_trajectory
from tests.free_ports import find_free_port
from tests.linuxcnc.cli_session import (
    PART,
    SHUTTLE,
    TRIES,
    compute_contour_errors,
    is_pass_repeated,
    record_demand,
    wait_for_state,
)
from tests.linuxcnc.linuxcnc_process import LinuxCnc, write_machine
from tests.sim.simulator_process import SimulatorProcess

ROOT = Path(__file__).resolve().parent.parent
SPEED_MM_S, ACCELERATION_MM_S2 = 500.0, 2000.0
ROOM_MM = ("-10", "300")
# what an axis' answers are, and where the retrofitter finds each
WHERE: Mapping[str, str] = {
    "screw_pitch_mm": "the screw's label",
    "nominal.R": "the motor's data sheet, of one phase",
    "nominal.L": "the motor's data sheet, of one phase",
    "nominal.K": "the motor's data sheet",
    "nominal.Jt": "rotor (data sheet) + screw + table mass x (pitch / 2 pi)^2",
    "regulators.current_limit_a": "the drive's tool",
    "regulators.voltage_limit_v": "the drive's DC link: its label",
    "correction.max_offset_um": "your decision: this table alone lets fdhil write",
    "correction.max_speed_mm_s": "your decision",
    "correction.max_acceleration_mm_s2": "your decision",
}


@dataclass
class Step:
    """A step of the retrofitter: how long the computer took, and the knowledge that it required."""

    name: str
    known: Mapping[str, str]
    seconds: float = 0.0


@dataclass
class Retrofit:
    """The retrofitter's folder, the Python that has fdhil, and the steps so far."""

    folder: Path
    python: str = sys.executable
    steps: list[Step] = field(default_factory=list)

    @property
    def file(self) -> Path:
        """The machine's configuration."""
        return self.folder / "machine.toml"

    @contextmanager
    def step(self, name: str, **known: str) -> Iterator[None]:
        """Measure a step and report it; ``known`` is the required knowledge."""
        print(f"{name} ...", flush=True)
        step, begun_s = Step(name, known), time.monotonic()
        yield
        step.seconds = time.monotonic() - begun_s
        self.steps.append(step)
        print(f"  {step.seconds / 60:.1f} min", flush=True)

    def run_command(self, *arguments: object, fine: tuple[int, ...] = (0,)) -> dict[str, Any]:
        """Run a command with --json; its own words end the study when its exit code is not ``fine``."""
        command = [self.python, "-m", "fdhil", *map(str, arguments), "--json"]
        done = subprocess.run(wrap_to_end_with_parent(command), capture_output=True, text=True, check=False)
        if done.returncode not in fine:
            sys.exit(f"{' '.join(map(str, arguments))} failed: {done.stdout[-3000:]}{done.stderr[-3000:]}")
        return dict(json.loads(done.stdout))

    def query_status(self) -> dict[str, Any]:
        """Query the daemon's status."""
        return self.run_command("status", self.file)


def write_simulator_config(folder: Path) -> Path:
    """Write the simulator's own configuration: the real drives, hidden from fdhil."""
    document = load_machine_document()
    document["sim"]["pace"] = "lockstep"
    (folder / "twin.toml").write_text(format_toml(document))
    return folder / "twin.toml"


def write_answers(folder: Path, twin: SimulatorProcess, port: int) -> dict[str, str]:
    """Write the answers from the data sheets; return each with its source."""
    sheet = load_machine_document()["axis"]
    reported: dict[str, Any] = {
        "bus": {name: dict(bus) for name, bus in twin.ready["buses"].items()},
        "g0": {"source": "linuxcnc"},
        "nc_source": {"linuxcnc": {"port": port}},
        "guard": {"clock": "sync"},
    }
    known = {
        "bus.can0": "`ip link`, or what the adapter's maker says",
        "g0.source": "linuxcnc, because its bridge is loaded",
        "nc_source.linuxcnc.port": "5571, unless you chose another",
        "guard.clock": "sync, because the simulated machine does not run by the clock; a real one needs no answer",
    }
    for axis, from_sheet in sheet.items():
        for path, where in WHERE.items():
            *tables, key = path.split(".")
            source, target = from_sheet, reported.setdefault("axis", {}).setdefault(axis, {})
            for name in tables:
                source, target = source[name], target.setdefault(name, {})
            target[key] = source[key]
            known[f"axis.{axis}.{path}"] = where
    (folder / "answers.toml").write_text(format_toml(reported))
    return known


def set_up(hour: Retrofit, twin: SimulatorProcess, port: int) -> None:
    """From the answers to commissioned drives."""
    mill = hour.folder / "mill"
    mill.mkdir()
    write_machine(mill, SPEED_MM_S, ACCELERATION_MM_S2, "", "XY")
    answers = hour.folder / "answers.toml"
    known = write_answers(hour.folder, twin, port)
    with hour.step("fdhil init, from LinuxCNC's files, the drives and the answers", **known):
        hour.run_command("init", hour.file, "--from-linuxcnc", mill / "machine.ini", "--answers", answers)
    with hour.step("fdhil doctor"):
        hour.run_command("doctor", hour.file, fine=(0, 1))  # this computer may have its own troubles
    with hour.step("fdhil check"):
        hour.run_command("check", hour.file)
    with hour.step(
        "fdhil commission, with a jog, test rapids and identification",
        room="how far each axis is free to go from where it stands",
        yes="the machine's own safety functions are effective, nobody is in its way",
    ):
        hour.run_command("commission", hour.file, "--yes", "--room", *ROOM_MM)


def run_first_cut(hour: Retrofit, nc: LinuxCnc) -> None:
    """Run from the first rapids to the corrected cut."""
    part = hour.folder / "part.csv"
    with hour.step("rapids of each axis, until fdhil believes what it has identified"):
        nc.run(SHUTTLE)
        wait_for_state(lambda: all(axis["accepted"] >= 4 for axis in hour.query_status()["axes"].values()))
    for tried in range(1, TRIES + 1):
        with hour.step("air cut, recorded by fdhil record", rest="longer than the program's longest dwell"):
            record_demand(hour.file, part, lambda: nc.run(PART))
        with hour.step("fdhil correct, fdhil arm"):
            hour.run_command("correct", part, "--config", hour.file, "--from-history")
            hour.run_command("arm", hour.file, part)
        with hour.step("the corrected cut"):
            nc.run(PART)
            wait_for_state(lambda: len(hour.query_status()["passes"]) == tried)  # noqa: B023 - called at once
        if is_pass_repeated(hour.query_status()):
            return
        print("  LinuxCNC has ordered something else than before, the guard has ramped to zero: once more")


def run_with_linuxcnc(hour: Retrofit, twin: SimulatorProcess, port: int, stack: ExitStack) -> None:
    """Daemon, guard and LinuxCNC run; cut."""
    with hour.step("fdhil run, fdhil-guard"):
        for name, command in (("guard", ["fdhil.cli.guard"]), ("daemon", ["fdhil", "run"])):
            stack.enter_context(ChildProcess(name, [*command, str(hour.file)], hour.folder / f"{name}.log"))
        run_directory = machine_config.load_config(hour.file).store.run_directory
        assert run_directory is not None
        wait_for_state((run_directory / SOCKET_NAME).exists)
    loads = f"loadusr -Wn {bridge.NAME} /usr/bin/python3 {bridge.__file__} --port {port} --channel 1\n"
    with hour.step("LinuxCNC on and homed", loadusr="the line that `python -m fdhil.bridges` prints, in the HAL file"):
        nc = stack.enter_context(LinuxCnc(SPEED_MM_S, ACCELERATION_MM_S2, loads, "XY"))
        stack.enter_context(nc.drive_simulator(twin))
    run_first_cut(hour, nc)


def install(hour: Retrofit) -> None:
    """Install fdhil into a fresh environment, which then runs the commands."""
    with hour.step("python -m venv, pip install fdhil"):
        venv.create(hour.folder / "venv", with_pip=True)
        hour.python = str(hour.folder / "venv" / "bin" / "python")
        subprocess.run(wrap_to_end_with_parent([hour.python, "-m", "pip", "install", "-q", str(ROOT)]), check=True)


def print_report(hour: Retrofit, before_um: float, after_um: float) -> None:
    """Print the steps, the required knowledge, and the results."""
    print("\nminutes  step")
    for step in hour.steps:
        print(f"{step.seconds / 60:7.1f}  {step.name}")
    known = {what: where for step in hour.steps for what, where in step.known.items()}
    print(f"{sum(step.seconds for step in hour.steps) / 60:7.1f}  together\n\n{len(known)} things to know:")
    for what, where in known.items():
        print(f"  {what}: {where}")
    print(
        f"\ncontour error at the simulated table: {before_um:.2f} um RMS in the first cut, {after_um:.2f} in the second"
    )


def main() -> None:
    """Run all steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--install", action="store_true", help="begin with pip install into a fresh environment")
    options = parser.parse_args()
    port = find_free_port()
    with interrupt_on_stop_signals(), tempfile.TemporaryDirectory(prefix="fdhil-hour-") as name:
        hour = Retrofit(Path(name))
        trace = hour.folder / "trace.csv"
        if options.install:
            install(hour)
        with SimulatorProcess(write_simulator_config(hour.folder), "--demand", "-", "--trace", trace) as twin:
            set_up(hour, twin, port)
            with ExitStack() as stack:
                run_with_linuxcnc(hour, twin, port, stack)
            twin.wait_for_event("finished")
        config = machine_config.load_config(hour.file)
        before_um, *_, after_um = compute_contour_errors(trace, load_trajectory(hour.folder / "part.csv", config))
        print_report(hour, before_um, after_um)
    sys.exit(after_um >= before_um)


if __name__ == "__main__":
    main()
