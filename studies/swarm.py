"""Random machines, programs and faults, each from one seed, on a whole machine in virtual time (``make swarm``).

Daemon, guard, store, drives and NC are the product's own, in one process (``tests/machine``). What must hold whatever
happens is judged at every SYNC; what is broken is reported with the command that repeats it.

A run goes on where the last one of the same code ended: figures and page add up what was run, after every life.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import hashlib
import json
import math
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil.errors import DeviceError
from studies import pages
from tests.machine.complete_machine import CompleteMachine, build_document, build_shuttle_program
from tests.machine.invariants import InvariantChecker

ROOM_MM = 120.0
FIRST_S = 3.0  # of rest after the last fault, until the drives must be at zero
FAULTS_END_S = 3.0
SHOWN = 40  # failures on the page
MOST_CPU_S = 5.0  # of a machine-second: what takes longer does not end
CODE = ("fdhil/**/*.py", "tests/machine/[!t]*.py", "tests/guard/frame_checks.py", "tests/bench.py", "studies/swarm.py")
SYNC_PERIODS_S = (0.001, 0.002, 0.004)
AXES = ("X", "XY", "XY", "XY", "XYZ")


class TooLong(Exception):
    """A life does not end."""


@dataclass
class Life:
    """One machine of a seed; ``happened`` counts what was done to it."""

    seed: int
    seconds: float
    machine: CompleteMachine
    judge: InvariantChecker
    rng: random.Random
    happened: Counter[str] = field(default_factory=Counter)
    parts: int = 0

    @property
    def axis(self) -> str:
        """Any axis."""
        return self.rng.choice(list(self.machine.plant.units))

    def run_life(self) -> None:
        """Let the machine learn its models, then work under faults until its time is over, and settle."""
        machine = self.machine
        end_s = machine.clock.now_s() + self.seconds
        machine.start_processes("guard")
        machine.start_processes("daemon")
        machine.switch_nc(on=True)
        machine.play_program(build_shuttle_program(machine.config.axis), "shuttle.ngc")
        machine.run_for(0.5)
        while machine.clock.now_s() < end_s:
            self.run_program()
            self.restore()
        self.settle_idle()

    def run_program(self) -> None:
        """Run one program, most of them armed; in most something happens."""
        machine, rng = self.machine, self.rng
        self.parts += 1
        text, name = self.draw_program(), f"part{self.parts % 4}.ngc"
        if rng.random() < 0.8:
            method = rng.choice((None, None, None, "mirror"))
            answer = machine.arm_program(
                machine.write_program(text, name), **({} if method is None else {"method": method})
            )
            self.happened["armed" if answer["ok"] else f"refused: {answer['code']}"] += 1
            if not answer["ok"] and answer["code"] == "PoorSkill" and rng.random() < 0.5:
                machine.play_program(build_shuttle_program(machine.config.axis), "shuttle.ngc")
            if rng.random() < 0.05:
                machine.request_daemon("disarm")
                self.happened["disarmed"] += 1
        machine.play_program(text, name, wait=False)
        for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
            machine.run_for(rng.uniform(0.01, 1.2))
            what = rng.choice(list(EVENTS))
            self.happened[what] += 1
            EVENTS[what](self)
        machine.run_for(rng.uniform(0.2, 3.0))
        if machine.service is not None and rng.random() < 0.5:
            self.judge.check_status()

    def start(self, name: str) -> None:
        """Start a process, once there is a bus that can be opened."""
        self.machine.run_until(lambda: not self.machine.bus.is_down)
        self.machine.start_processes(name)

    def draw_program(self) -> str:
        """Draw a program of a few moves from and to zero: lines, rectangles and circles, with rests between."""
        rng, axes = self.rng, list(self.machine.plant.units)
        lines = ["G21 G90 G94", f"G4 P{rng.choice((0.1, 0.3))}"]
        for _ in range(rng.randint(1, 4)):
            feed = f"F{rng.uniform(4000, 9000):.0f}"
            shape = rng.choice(("line", "rectangle", "rectangle", "circle", "rapid"))
            there = {axis: rng.uniform(-ROOM_MM, ROOM_MM) for axis in axes if rng.random() < 0.7}
            words = " ".join(f"{axis}{place_mm:.3f}" for axis, place_mm in there.items())
            if shape == "circle" and {"X", "Y"} <= set(axes):
                lines.append(f"G2 I{rng.uniform(5, 40):.3f} J0 {feed}")
            elif shape == "rectangle":
                corners = [f"{axis}{place_mm:.3f}" for axis, place_mm in there.items()] + [f"{axis}0" for axis in there]
                lines += [f"G1 {corner} {feed}" for corner in corners]
            elif words:
                lines.append(f"G0 {words}" if shape == "rapid" else f"G1 {words} {feed}")
            if rng.random() < 0.3:
                lines.append(f"G4 P{rng.uniform(0.01, 0.4):.2f}")
        return "\n".join([*lines, "G1 " + " ".join(f"{axis}0" for axis in axes) + " F8000", "G4 P0.2", "M2", ""])

    def restore(self) -> None:
        """Do what an operator does before the next part: end faults, restart dead processes, adopt residual offsets."""
        machine = self.machine
        with contextlib.suppress(RuntimeError):
            machine.run_until(lambda: machine.plant.faults.is_idle, FAULTS_END_S)
        for name, runs in (("guard", machine.guard), ("daemon", machine.service)):
            if runs is None:
                self.start(name)
        machine.plant.nc.set_feed_hold(False)
        machine.plant.nc.set_override(100.0)
        if machine.plant.nc.phase.name != "READY":
            with contextlib.suppress(RuntimeError):
                machine.switch_nc(on=True)
        machine.plant.nc.stop_path()
        machine.run_for(0.8)
        if machine.read_guard_state == "FROZEN" or any(machine.read_offset_um().values()):
            answer = machine.adopt_offset()
            self.happened["adopted" if answer["ok"] else "adoption refused"] += 1
            machine.run_for(1.0)
        with contextlib.suppress(DeviceError):
            machine.attest_facts()

    def settle_idle(self) -> None:
        """End all faults, and verify that the drives come to zero with only the actions that the messages advise."""
        machine = self.machine
        for _ in range(3):
            self.restore()
            machine.run_for(FIRST_S)
            if not any(machine.read_offset_um().values()):
                break
            for axis in machine.plant.units:  # what may not be adopted is gone with the drive's power
                machine.inject_fault("reboot", axis=axis)
        self.judge.check_status()
        machine.stop_processes("daemon")
        machine.stop_processes("guard")
        self.judge.check_end()


def fault(kind: str, low: float | None = None, high: float | None = None, **fields: Any) -> Callable[[Life], None]:
    """Return what begins a fault of the simulated machine for a while, with a value between two bounds."""

    def begin(life: Life) -> None:
        rng, given = life.rng, dict(fields)
        if low is not None and high is not None:
            given["value"] = rng.randint(int(low), int(high)) if isinstance(low, int) else rng.uniform(low, high)
        if given.pop("of_axis", True):
            given["axis"] = life.axis
        if given.pop("share", False):
            given["percent"] = rng.choice((1.0, 10.0, 50.0, 100.0))
        if given.pop("offset_frame", False):
            given["can_id"] = life.rng.choice((0x301, 0x302))
            given["data"] = rng.randint(-900, 900).to_bytes(4, "little", signed=True).hex()
        life.machine.inject_fault(kind, duration_s=math.exp(rng.uniform(math.log(0.001), math.log(1.0))), **given)

    return begin


def kill(name: str) -> Callable[[Life], None]:
    """Return what kills a process and starts it again after a while."""

    def act(life: Life) -> None:
        machine = life.machine
        if (machine.guard if name == "guard" else machine.service) is None:
            return
        machine.kill_process(name)
        machine.run_for(life.rng.choice((0.0, 0.02, 0.3, 1.5)))
        life.start(name)

    return act


def restart(name: str) -> Callable[[Life], None]:
    """Return what ends a process by SIGTERM and starts it again."""

    def act(life: Life) -> None:
        if (life.machine.guard if name == "guard" else life.machine.service) is not None:
            life.machine.stop_processes(name)
            life.start(name)

    return act


def foreign_offset(life: Life) -> None:
    """Another node writes an offset, by PDO or SDO."""
    rng = life.rng
    unit = life.machine.plant.units[life.axis]
    value = rng.randint(-900, 900).to_bytes(4, "little", signed=True)
    node = unit.drive.node_id
    frame = (0x300 + node, value) if rng.random() < 0.5 else (0x600 + node, b"\x23\xb0\x60\x00" + value)
    life.machine.send_frame(*frame)


def set_clock(life: Life) -> None:
    """Somebody sets the PC's clock."""
    life.machine.clock.set_s += life.rng.choice((-86_400.0, -3.0, 3.0, 7200.0))


def feed_hold(life: Life) -> None:
    """Hold the feed, and release it."""
    life.machine.plant.nc.set_feed_hold(True)
    life.machine.run_for(life.rng.uniform(0.05, 1.0))
    life.machine.plant.nc.set_feed_hold(False)


def emergency_stop(life: Life) -> None:
    """Cut the drives' power, as an emergency stop does."""
    for axis in life.machine.plant.units:
        life.machine.inject_fault("power_off", axis=axis, duration_s=0.5)


def disarm(life: Life) -> None:
    """Disarm."""
    if life.machine.service is not None:
        life.machine.request_daemon("disarm")


EVENTS: Mapping[str, Callable[[Life], None]] = {
    "daemon killed": kill("daemon"),
    "guard killed": kill("guard"),
    "daemon restarted": restart("daemon"),
    "guard restarted": restart("guard"),
    "disarmed": disarm,
    "TPDO lost": fault("drop_tpdo", 1, 4),
    "frames lost": fault("bus_drop", share=True),
    "frames doubled": fault("bus_duplicate", 1, 3, share=True),
    "frames delayed": fault("bus_delay", 1, 20, share=True),
    "frames corrupted": fault("bus_mutate", 1, 8, share=True),
    "frames truncated": fault("bus_truncate", 0, 7, share=True),
    "frames reordered": fault("bus_reorder", 1, 10, share=True),
    "foreign offset": foreign_offset,
    "foreign writer": fault("frame", offset_frame=True, of_axis=False),
    "SYNC lost": fault("sync_lost", of_axis=False),
    "bus down": fault("bus_down", of_axis=False),
    "drive tripped": fault("trip", 0x3210, 0x3210),
    "drive rebooted": fault("reboot"),
    "offset ignored": fault("ignore_offset"),
    "offset scaled": fault("offset_scale", -2.0, 2.0),
    "current sensor stuck": fault("current_stuck"),
    "speed sensor dead": fault("speed_gain", 0, 0),
    "load torque": fault("load_torque", -40.0, 40.0),
    "NC stopped": lambda life: life.machine.plant.nc.stop_path(),
    "feed held": feed_hold,
    "override": lambda life: life.machine.plant.nc.set_override(life.rng.choice((30.0, 70.0, 120.0))),
    "emergency stop": emergency_stop,
    "clock set": set_clock,
}


def draw_machine(rng: random.Random) -> dict[str, Any]:
    """Draw a machine."""
    made = build_document(rng.choice(AXES))
    made["machine"]["sync_period_s"] = rng.choice(SYNC_PERIODS_S)
    for axis in made["axis"].values():
        axis["nominal"]["Jt"] *= rng.uniform(0.9, 1.1)
        axis["correction"]["max_offset_um"] = rng.choice((150.0, 250.0, 250.0))
        axis["drive"] = {"sign": rng.choice((1, -1))}
    return made


def run_machine_life(seed: int, seconds: float, folder: Path) -> tuple[list[str], Counter[str], CompleteMachine]:
    """Let the machine of a seed live in a folder; return what was wrong, what was counted, and the machine."""
    rng = random.Random(seed)
    machine = CompleteMachine(seed, draw_machine(rng), folder=folder)
    with machine:
        begun_s = machine.clock.now_s()
        kind = f"{'+'.join(machine.config.axis)}, SYNC every {1e3 * machine.config.machine.sync_period_s:g} ms"
        life = Life(seed, seconds, machine, InvariantChecker(machine), rng)
        _expired.clear()
        signal.setitimer(signal.ITIMER_PROF, MOST_CPU_S * seconds, MOST_CPU_S * seconds)
        try:
            life.run_life()
        except TooLong:
            pass
        except Exception as error:  # noqa: BLE001 - whatever ends a life is a finding
            machine.wrong.append(f"{machine.clock.now_s():.3f} s: {type(error).__name__}: {error}"[:3000])
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        machine.wrong += _expired[:1]  # told even where a library made its own of the exception
        machine.bus.deliver_frames()
        counted = life.judge.counted + Counter({f"event {name}": n for name, n in life.happened.items()})
        counted["frames"] += machine.bus.frames
        counted[f"axes {kind}"] += 1
        counted["milliseconds"] += round(1e3 * (machine.clock.now_s() - begun_s))
        return machine.wrong, counted, machine


def assess_life(seed: int, seconds: float) -> tuple[int, list[str], dict[str, int], float]:
    """Let one machine live; return its seed, violations, counts, and the processor time."""
    begun_s = time.process_time()
    with tempfile.TemporaryDirectory(prefix="swarm-") as folder:
        wrong, counted, _ = run_machine_life(seed, seconds, Path(folder))
    gc.collect()
    return seed, wrong, dict(counted), time.process_time() - begun_s


def _begin_worker() -> None:
    """Collect garbage between two lives alone, as the guard's process never does; end a life that does not end."""
    gc.freeze()
    gc.disable()
    signal.signal(signal.SIGPROF, _too_long)


_expired: list[str] = []


def _too_long(*_: object) -> None:
    _expired.append(f"more than {MOST_CPU_S:g} s of processor time for each machine-second")
    raise TooLong


def format_replay_command(seed: int, seconds: float) -> str:
    """Return the command that repeats a life."""
    return f"make swarm N=1 SEED={seed} SECONDS={seconds:g}"


def compute_code_digest() -> str:
    """Return the digest of the code under test."""
    files = sorted(path for pattern in CODE for path in pages.ROOT.glob(pattern))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def make_empty_figures(code: str) -> dict[str, Any]:
    """Return the figures of a version of the code before its first life."""
    return {"code": code, "runs": [], "machines": 0, "counted": {}, "processor_s": 0.0, "failures": [], "earlier": []}


def load_figures(path: Path, code: str) -> dict[str, Any]:
    """Return the figures in a file, to be added to; those of another version of the code become one line of a new."""
    figures = make_empty_figures(code)
    if not path.exists():
        return figures
    document = json.loads(path.read_text("utf-8"))
    before: dict[str, Any] = document["figures"]
    if before.get("code") == code:
        return before
    line = {
        "commit": document["run"]["commit"],
        "machines": before["machines"],
        "machine_s": before["counted"].get("milliseconds", 0) / 1e3,
        "failures": len(before["failures"]),
    }
    return figures | {"earlier": [*before.get("earlier", []), line]}


def find_next_seed(figures: Mapping[str, Any]) -> int:
    """Return the first seed that was not run."""
    return max((last for _, last, _ in figures["runs"]), default=0) + 1


def is_counted(figures: Mapping[str, Any], seed: int, seconds: float) -> bool:
    """Return whether this life is in the figures: it may be repeated, and is not counted again."""
    return any(first <= seed <= last and of == seconds for first, last, of in figures["runs"])


def run_lives(options: argparse.Namespace, seeds: range) -> Iterator[tuple[int, list[str], dict[str, int], float]]:
    """Let all machines live; yield of each its seed, what was wrong, what was counted and the processor time."""
    with ProcessPoolExecutor(options.processes, initializer=_begin_worker, max_tasks_per_child=25) as pool:
        yield from pool.map(assess_life, seeds, [options.seconds] * len(seeds))


def add_life(
    figures: dict[str, Any], seed: int, seconds: float, wrong: list[str], counted: Mapping[str, int], used_s: float
) -> None:
    """Add a life to the figures."""
    runs = figures["runs"]
    if runs and runs[-1][1:] == [seed - 1, seconds]:
        runs[-1][1] = seed
    else:
        runs.append([seed, seed, seconds])
    figures["machines"] += 1
    figures["counted"] = dict(sorted((Counter(figures["counted"]) + Counter(counted)).items()))
    figures["processor_s"] += used_s
    if wrong:
        figures["failures"].append({"seed": seed, "wrong": wrong[:5], "replay": format_replay_command(seed, seconds)})


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    counted, failures = figures["counted"], figures["failures"]
    lived_s = counted["milliseconds"] / 1e3
    lines = pages.write_head("Swarm: random machines, programs and faults on one virtual clock", "swarm", run)
    lines += pages.wrap_paragraph(
        f"""Each machine comes from one seed: its axes, programs, faults and their times. Daemon, guard, store,
        simulated drives and NC run in one process on one virtual clock (`tests/machine`), so that a seed gives the same
        frames, history and log each time. With this version of the code {figures["machines"]} machines lived
        {lived_s:.0f} machine-seconds in {figures["processor_s"]:.0f} s of processor time
        ({lived_s / figures["processor_s"]:.1f} times real time, judging included); the next run adds to it."""
    )
    lines += pages.wrap_paragraph(
        f"""Judged: {counted["SYNC"]} SYNC with {counted["frames"]} frames, {counted.get("offset frames", 0)} offset
        frames of the guard, {counted.get("statuses", 0)} statuses, {counted.get("records", 0)} rows of the history and
        {counted.get("audit lines", 0)} lines of the audit."""
    )
    lines += [
        "What must hold:",
        "",
        "- no offset frame exceeds the limits of value, rate, acceleration or variation, seen from the wire;",
        "- once the faults have ended, every drive comes to zero by what the messages advise;",
        "- a guard at rest that reports what a drive holds reports what it holds; so does the daemon;",
        "- no acknowledged window is missing or doubled in the history; history and audit are sound;",
        "- neither daemon nor guard ends with an error.",
        "",
    ]
    lines += _table(counted, "axes ", "axes and SYNC")
    lines += _table(counted, "event ", "what happened")
    lines += pages.wrap_paragraph(f"Broken: {pages.format_share(len(failures), figures['machines'])} machines.")
    lines += [f"- `{each['replay']}`: {' '.join(each['wrong'][0].split())[:200]}" for each in failures[:SHOWN]]
    if figures["earlier"]:
        lines += ["", "Earlier versions of the code:", ""]
        lines += pages.write_table(
            ("commit", "machines", "machine-seconds", "broken"),
            [
                (each["commit"], str(each["machines"]), f"{each['machine_s']:.0f}", str(each["failures"]))
                for each in figures["earlier"]
            ],
        )
    return "\n".join(lines)


def _table(counted: Mapping[str, int], prefix: str, title: str) -> list[str]:
    rows = [(name.removeprefix(prefix), str(n)) for name, n in sorted(counted.items()) if name.startswith(prefix)]
    return [*pages.write_table((title, "times"), rows), ""]


def main() -> None:
    """Run machines, and add them to the figures and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--first-seed", type=int, help="default: the first that this version of the code has not run")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=pages.FOLDER)
    options = parser.parse_args()
    path = options.out / "swarm.json"
    figures = load_figures(path, compute_code_digest())
    first = find_next_seed(figures) if options.first_seed is None else options.first_seed
    run = pages.describe_provenance(
        f"python -m studies.swarm --machines {options.machines} --seconds {options.seconds:g}"
    )
    options.out.mkdir(parents=True, exist_ok=True)
    broken = False
    for seed, wrong, counted, used_s in run_lives(options, range(first, first + options.machines)):
        if wrong:
            broken = True
            print(f"{format_replay_command(seed, options.seconds)}\n  " + "\n  ".join(wrong[:5]), flush=True)
        if not is_counted(figures, seed, options.seconds):
            add_life(figures, seed, options.seconds, wrong, counted, used_s)
        write_results(path, run, figures)
    print(pages.render_page(json.loads(path.read_text("utf-8"))))
    sys.exit(broken)


def write_results(path: Path, run: pages.Run, figures: Mapping[str, Any]) -> None:
    """Write figures and page, so that what was run is kept however the run ends."""
    seeds = ", ".join(f"{first} to {last} ({seconds:g} s each)" for first, last, seconds in figures["runs"])
    document = {"study": "swarm", "run": {**run, "seeds": seeds}, "figures": pages.convert_to_json(figures)}
    part = path.with_suffix(".part")
    part.write_text(json.dumps(document, separators=(",", ":")) + "\n", "utf-8")
    part.replace(path)
    pages.write_page(path)


if __name__ == "__main__":
    main()
