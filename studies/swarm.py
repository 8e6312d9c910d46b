"""Random machines, programs and faults, each from one seed, on a whole machine in virtual time (``make swarm``).

Daemon, guard, store, drives and NC are the product's own, in one process (``tests/machine``). What must hold whatever
happens is judged at every SYNC; what is broken is reported with the command that repeats it.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil.errors import DeviceError
from studies import pages
from tests.machine.invariants import Judge
from tests.machine.whole_machine import Machine, document, shuttle

ROOM_MM = 120.0
FIRST_S = 3.0  # of rest after the last fault, until the drives must be at zero
FAULTS_END_S = 3.0
SHOWN = 40  # failures on the page


@dataclass
class Life:
    """One machine of a seed; ``happened`` counts what was done to it."""

    seed: int
    seconds: float
    machine: Machine
    judge: Judge
    rng: random.Random
    happened: Counter[str] = field(default_factory=Counter)
    parts: int = 0

    @property
    def axis(self) -> str:
        """Any axis."""
        return self.rng.choice(list(self.machine.plant.units))

    def live(self) -> None:
        """Let the machine learn its models, then work and suffer until its time is over, and come to rest."""
        machine = self.machine
        end_s = machine.clock.now_s() + self.seconds
        machine.start("guard")
        machine.start("daemon")
        machine.nc(on=True)
        machine.play(shuttle(machine.config.axis), "shuttle.ngc")
        machine.run(0.5)
        while machine.clock.now_s() < end_s:
            self.cut()
            self.restore()
        self.rest()

    def cut(self) -> None:
        """Run one program, most of them armed; in most something happens."""
        machine, rng = self.machine, self.rng
        self.parts += 1
        text, name = self.program(), f"part{self.parts % 4}.ngc"
        if rng.random() < 0.8:
            method = rng.choice((None, None, None, "mirror"))
            answer = machine.arm(machine.write(text, name), **({} if method is None else {"method": method}))
            self.happened["armed" if answer["ok"] else f"refused: {answer['code']}"] += 1
            if rng.random() < 0.05:
                machine.ask("disarm")
                self.happened["disarmed"] += 1
        machine.play(text, name, wait=False)
        for _ in range(rng.choice((0, 1, 1, 1, 2, 3))):
            machine.run(rng.uniform(0.01, 1.2))
            what = rng.choice(list(EVENTS))
            self.happened[what] += 1
            EVENTS[what](self)
        machine.run(rng.uniform(0.2, 3.0))
        if machine.service is not None and rng.random() < 0.5:
            self.judge.status()

    def start(self, name: str) -> None:
        """Start a process, once there is a bus that can be opened."""
        self.machine.run_until(lambda: not self.machine.bus.is_down)
        self.machine.start(name)

    def program(self) -> str:
        """Draw a program of a few moves from and to zero."""
        rng, axes = self.rng, list(self.machine.plant.units)
        lines = ["G21 G90 G94", f"G4 P{rng.choice((0.1, 0.3))}"]
        for _ in range(rng.randint(1, 5)):
            words = " ".join(f"{axis}{rng.uniform(-ROOM_MM, ROOM_MM):.3f}" for axis in axes if rng.random() < 0.7)
            if words and rng.random() < 0.8:
                lines.append(f"G1 {words} F{rng.uniform(4000, 9000):.0f}")
            elif words:
                lines.append(f"G0 {words}")
            if rng.random() < 0.3:
                lines.append(f"G4 P{rng.uniform(0.01, 0.4):.2f}")
        return "\n".join([*lines, "G1 " + " ".join(f"{axis}0" for axis in axes) + " F8000", "G4 P0.2", "M2", ""])

    def restore(self) -> None:
        """Do what an operator does before the next part: end faults, start what is dead, take over what is left."""
        machine = self.machine
        with contextlib.suppress(RuntimeError):
            machine.run_until(lambda: machine.plant.faults.idle, FAULTS_END_S)
        for name, runs in (("guard", machine.guard), ("daemon", machine.service)):
            if runs is None:
                self.start(name)
        machine.plant.nc.feed_hold(False)
        machine.plant.nc.set_override(100.0)
        if machine.plant.nc.phase.name != "READY":
            with contextlib.suppress(RuntimeError):
                machine.nc(on=True)
        machine.plant.nc.stop()
        machine.run(0.8)
        if machine.guard_state == "FROZEN":
            answer = machine.adopt()
            self.happened["adopted" if answer["ok"] else "adoption refused"] += 1
            machine.run(1.0)
        with contextlib.suppress(DeviceError):
            machine.attest()

    def rest(self) -> None:
        """End all faults, and see the drives come to zero with no more than what the messages advise."""
        machine = self.machine
        for _ in range(3):
            self.restore()
            machine.run(FIRST_S)
            if not any(machine.held_um().values()):
                break
            for axis in machine.plant.units:  # what may not be adopted is gone with the drive's power
                machine.fault("reboot", axis=axis)
        self.judge.status()
        machine.stop("daemon")
        machine.stop("guard")
        self.judge.end()


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
        life.machine.fault(kind, duration_s=math.exp(rng.uniform(math.log(0.001), math.log(1.0))), **given)

    return begin


def kill(name: str) -> Callable[[Life], None]:
    """Return what kills a process and starts it again after a while."""

    def act(life: Life) -> None:
        machine = life.machine
        if (machine.guard if name == "guard" else machine.service) is None:
            return
        machine.kill(name)
        machine.run(life.rng.choice((0.0, 0.02, 0.3, 1.5)))
        life.start(name)

    return act


def restart(name: str) -> Callable[[Life], None]:
    """Return what ends a process by SIGTERM and starts it again."""

    def act(life: Life) -> None:
        if (life.machine.guard if name == "guard" else life.machine.service) is not None:
            life.machine.stop(name)
            life.start(name)

    return act


def foreign_offset(life: Life) -> None:
    """Another node writes an offset, by PDO or SDO."""
    rng = life.rng
    unit = life.machine.plant.units[life.axis]
    value = rng.randint(-900, 900).to_bytes(4, "little", signed=True)
    node = unit.drive.node_id
    frame = (0x300 + node, value) if rng.random() < 0.5 else (0x600 + node, b"\x23\xb0\x60\x00" + value)
    life.machine.send(*frame)


def set_clock(life: Life) -> None:
    """Somebody sets the PC's clock."""
    life.machine.clock.set_s += life.rng.choice((-86_400.0, -3.0, 3.0, 7200.0))


def feed_hold(life: Life) -> None:
    """Hold the feed, and release it."""
    life.machine.plant.nc.feed_hold(True)
    life.machine.run(life.rng.uniform(0.05, 1.0))
    life.machine.plant.nc.feed_hold(False)


def emergency_stop(life: Life) -> None:
    """Cut the drives' power, as an emergency stop does."""
    for axis in life.machine.plant.units:
        life.machine.fault("power_off", axis=axis, duration_s=0.5)


def disarm(life: Life) -> None:
    """Disarm."""
    if life.machine.service is not None:
        life.machine.ask("disarm")


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
    "NC stopped": lambda life: life.machine.plant.nc.stop(),
    "feed held": feed_hold,
    "override": lambda life: life.machine.plant.nc.set_override(life.rng.choice((30.0, 70.0, 120.0))),
    "emergency stop": emergency_stop,
    "clock set": set_clock,
}


def drawn(rng: random.Random) -> dict[str, Any]:
    """Draw a machine."""
    made = document(rng.choice(("XY", "XY", "XYZ")))
    for axis in made["axis"].values():
        axis["nominal"]["Jt"] *= rng.uniform(0.9, 1.1)
        axis["correction"]["max_offset_um"] = rng.choice((100.0, 150.0, 250.0))
        axis["drive"] = {"sign": rng.choice((1, -1))}
    return made


def life_of(seed: int, seconds: float, folder: Path) -> tuple[list[str], Counter[str], Machine]:
    """Let the machine of a seed live in a folder; return what was wrong, what was counted, and the machine."""
    rng = random.Random(seed)
    machine = Machine(seed, drawn(rng), folder=folder)
    with machine:
        begun_s = machine.clock.now_s()
        life = Life(seed, seconds, machine, Judge(machine), rng)
        try:
            life.live()
        except Exception as error:  # noqa: BLE001 - whatever ends a life is a finding
            machine.wrong.append(f"{machine.clock.now_s():.3f} s: {type(error).__name__}: {error}"[:3000])
        machine.bus.flush()
        counted = life.judge.counted + Counter({f"event {name}": n for name, n in life.happened.items()})
        counted["frames"] += machine.bus.frames
        counted["milliseconds"] += round(1e3 * (machine.clock.now_s() - begun_s))
        return machine.wrong, counted, machine


def judged(seed: int, seconds: float) -> tuple[int, list[str], dict[str, int], float]:
    """Let one machine live; return its seed, what was wrong, what was counted, and the processor time."""
    begun_s = time.process_time()
    with tempfile.TemporaryDirectory(prefix="swarm-") as folder:
        wrong, counted, _ = life_of(seed, seconds, Path(folder))
    return seed, wrong, dict(counted), time.process_time() - begun_s


def _quiet() -> None:
    """Do without the garbage collector, as the guard's process does: a worker ends after a few lives."""
    gc.freeze()
    gc.disable()


def replay(seed: int, seconds: float) -> str:
    """Return the command that repeats a life."""
    return f"make swarm N=1 SEED={seed} SECONDS={seconds:g}"


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Let all machines live."""
    seeds = range(options.seed, options.seed + options.machines)
    counted, failures, used_s = Counter[str](), [], 0.0
    with ProcessPoolExecutor(options.processes, initializer=_quiet, max_tasks_per_child=10) as pool:
        for seed, wrong, found, seconds in pool.map(judged, seeds, [options.seconds] * len(seeds)):
            counted.update(found)
            used_s += seconds
            if wrong:
                failures.append({"seed": seed, "wrong": wrong[:5], "replay": replay(seed, options.seconds)})
                print(f"{replay(seed, options.seconds)}\n  " + "\n  ".join(wrong[:5]), flush=True)
    return {
        "machines": len(seeds),
        "seconds": options.seconds,
        "counted": dict(sorted(counted.items())),
        "processor_s": used_s,
        "failures": failures,
    }


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page."""
    counted, failures = figures["counted"], figures["failures"]
    lived_s = counted["milliseconds"] / 1e3
    lines = pages.head("Swarm: random machines, programs and faults on one virtual clock", "swarm", run)
    lines += pages.paragraph(
        f"""Each machine comes from one seed: its axes, programs, faults and their times. Daemon, guard, store,
        simulated drives and NC run in one process on one virtual clock (`tests/machine`), so that a seed gives the same
        frames, history and log each time. {figures["machines"]} machines lived {lived_s:.0f} machine-seconds in
        {figures["processor_s"]:.0f} s of processor time ({lived_s / figures["processor_s"]:.1f} times real time,
        judging included)."""
    )
    lines += pages.paragraph(
        f"""Judged: {counted["SYNC"]} SYNC with {counted["frames"]} frames, {counted.get("offset frames", 0)} offset
        frames of the guard, {counted["statuses"]} statuses, {counted["records"]} rows of the history and
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
    names = {name.removeprefix("event "): n for name, n in counted.items() if name.startswith("event ")}
    lines += pages.grid(("what happened", "times"), [(name, str(n)) for name, n in sorted(names.items())])
    broken = f"Broken: {pages.of(len(failures), figures['machines'])} machines."
    lines += ["", *pages.paragraph(broken)]
    for failure in failures[:SHOWN]:
        lines += [f"- `{failure['replay']}`: {_short(failure['wrong'])}"]
    return "\n".join(lines)


def _short(wrong: Sequence[str]) -> str:
    return " ".join(wrong[0].split())[:200]


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    figures = pages.conduct("swarm", parser, _seeds, measure)
    sys.exit(bool(figures["failures"]))


def _seeds(options: argparse.Namespace) -> str:
    return f"{options.seed} to {options.seed + options.machines - 1}"


if __name__ == "__main__":
    main()
