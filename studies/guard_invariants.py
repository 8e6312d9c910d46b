"""The guard's invariants on random buses (``python -m studies.guard_invariants``).

Faults, foreign and forged frames, restarts and requests in any order, at any time. Every frame that the guard sends is
judged by the wire and by what the drive held, not by the guard's own state. The page goes to
``docs/studies/guard_invariants.md``, the figures beside it as JSON. Exit code 1 when a frame broke a limit.
"""

from __future__ import annotations

import argparse
import random
import struct
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

from fdhil.guard.protocol import SENDING, Mode
from fdhil.guard.state import Request
from studies import pages
from tests.guard.machine import ENABLED, RECORD, Bench, arm_request, bench
from tests.guard.wire import Wire

EPISODE = 5000
COMPARED = Request("compared", True, compared={"X": RECORD})
ADOPT = Request("adopt", True)


@dataclass
class Walk:
    """One machine from the guard's start on, ``EPISODE`` SYNC of it; ``wrong`` are frames that broke a limit."""

    rng: random.Random
    machine: Bench = field(init=False)
    wire: Wire = field(init=False)
    seen: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    drop: dict[int, int] = field(default_factory=dict)
    mode: Mode = Mode.OFF

    def __post_init__(self) -> None:
        rng, made = self.rng, bench(amplitude=self.rng.choice((100, 300, 800)), axes=("X",))
        own = made.settings.axes[0]
        record = {"record": rng.choice((RECORD, RECORD, RECORD, "")), "record_void": rng.random() < 0.1}
        settings = replace(made.settings, axes=(replace(own, **record),))
        self.machine = Bench(settings, made.path, made.demand, made.drives)
        held = rng.choice((0, rng.randint(-819, 819), rng.randint(-819, 819), rng.randint(-(2**24), 2**24)))
        self.machine.drives[0].hold(held)
        self.wire = Wire(own.limits, held)

    def cycle(self, request: Request | None = None, late: bool = False, left: bool = True, nc: bool = True) -> None:
        """One SYNC; its frame is judged."""
        machine = self.machine
        if not left and machine.outputs and machine.outputs[-1].offsets is not None:
            self.wire.lost()
        machine.outputs, machine.frames, machine.held = machine.outputs[-1:], machine.frames[-1:], []
        dropped = tuple([cob_id for cob_id, until in self.drop.items() if machine.tick < until])
        output = machine.sync(request, late=late, transmitted=left, nc=nc, drop=dropped)
        self._judge(output.offsets, late)

    def _judge(self, offsets: tuple[int, ...] | None, late: bool) -> None:
        machine, before, self.mode = self.machine, self.mode, self.machine.mode
        self.seen["sync"] += 1
        if self.mode is not before:
            self.seen[f"{before.value} to {self.mode.value}"] += 1
        if offsets is None:
            self.wire.nothing()
            return
        self.seen["frames"] += 1
        wrong = self.wire.ours(offsets[0], machine.drives[0].offset)
        if late or not {before, self.mode} & SENDING:
            wrong = f"a frame in {before.value}, {self.mode.value}"
        if wrong is not None:
            self.wrong.append(f"SYNC {machine.tick}, {before.value} to {self.mode.value}: {wrong}")

    def run(self) -> None:
        """Let things happen, with quiet between them and every now and then all that it takes to be armed."""
        while self.seen["sync"] < EPISODE:
            name, happen = self.rng.choice(HAPPENINGS)
            self.seen[name] += 1
            happen(self)
            for _ in range(self.rng.choice((0, 1, 5, 20, 60))):
                self.cycle()

    def foreign(self, value: int, cob_id: int = 0x301) -> None:
        """Another node writes the offset, by our COB-ID or by SDO."""
        data = struct.pack("<i", value) if cob_id == 0x301 else struct.pack("<BHBi", 0x23, 0x60B0, 0, value)
        self.machine.inject(cob_id, data)
        self.wire.foreign(value)


def armed(walk: Walk) -> None:
    """All good again: compared, adopted where something stands, armed and into the path."""
    machine, drive = walk.machine, walk.machine.drives[0]
    drive.statusword, drive.mode, drive.answers, drive.scale, drive.position_error = ENABLED, 8, True, 1.0, 0
    drive.remapped = False
    walk.drop.clear()
    machine.listener.error("active")
    machine.hear(0x701, b"\x05")
    machine.main_alive, machine.rest, machine.playing, machine.row = True, None, False, 0
    for request in (COMPARED, None, ADOPT, None, arm_request()):
        walk.cycle(request)
        for _ in range(45):
            walk.cycle()
    for _ in range(20):
        walk.cycle(arm_request() if machine.mode is Mode.OFF else None)
    machine.playing = True
    for _ in range(walk.rng.randint(20, 400)):
        walk.cycle()


def restarted(walk: Walk) -> None:
    """The guard is killed; the next one knows nothing, the drive holds what it held."""
    machine = walk.machine
    again = Bench(machine.settings, machine.path, machine.demand, machine.drives)
    again.tick, again.counter, again.row = machine.tick, machine.counter, machine.row
    walk.machine, walk.mode = again, Mode.OFF


def cycles(**how: bool) -> Callable[[Walk], None]:
    """Return a happening of a few cycles that are not as they should be."""

    def happen(walk: Walk) -> None:
        for _ in range(walk.rng.randint(1, 15)):
            walk.cycle(**how)

    return happen


def drive(**values: tuple[object, ...]) -> Callable[[Walk], None]:
    """Return a happening in which the drive becomes something of this."""

    def happen(walk: Walk) -> None:
        for name, among in values.items():
            setattr(walk.machine.drives[0], name, walk.rng.choice(among))

    return happen


def forged(walk: Walk) -> None:
    """TPDO3 as another node would make it, once or some times, now and then right behind the drive's own."""
    value = walk.rng.choice((walk.rng.randint(-819, 819), walk.rng.randint(-(2**31), 2**31 - 1)))
    for _ in range(walk.rng.choice((1, 1, 2, 3, 12))):
        walk.machine.hear(0x381, struct.pack("<ii", walk.rng.choice((value, 0)), value))
        for _ in range(walk.rng.choice((0, 1, 1, 9, 10))):
            walk.cycle()


def garbage(walk: Walk) -> None:
    """Any bytes under a COB-ID that the guard listens to."""
    cob_id = walk.rng.choice((0x181, 0x281, 0x381, 0x481, 0x201, 0x000, 0x081, 0x701, 0x601, 0x764))
    if cob_id != 0x601:
        walk.machine.hear(cob_id, walk.rng.randbytes(walk.rng.randint(0, 8)))


def lost_tpdo(walk: Walk) -> None:
    cob_id = walk.rng.choice((0x181, 0x281, 0x381, 0x381, 0x481))
    walk.drop[cob_id] = walk.machine.tick + walk.rng.choice((1, 12, 25, 200))


def rebooted(walk: Walk) -> None:
    walk.machine.reboot(0)
    walk.wire.foreign(0)


def requested(walk: Walk) -> None:
    kind = walk.rng.choice(("disarm", "adopt", "adopt", "stop", "compared"))
    walk.cycle(Request(kind, walk.rng.random() < 0.8, compared={"X": RECORD}))


def no_sync(walk: Walk) -> None:
    output = walk.machine.silence()
    if output.offsets is not None:
        walk.wrong.append("a frame without SYNC")
    walk.mode = walk.machine.mode


def error_state(walk: Walk) -> None:
    walk.machine.listener.error(walk.rng.choice(("active", "warning", "passive", "off", "restarted")))


def written(walk: Walk) -> None:
    walk.machine.hear(0x601, struct.pack("<BHBI", 0x23, walk.rng.choice((0x6065, 0x1A02, 0x6060)), 0, 0))


def jumped(walk: Walk) -> None:
    walk.machine.row = max(0, walk.machine.row + walk.rng.randint(-30, 30))


def stands(walk: Walk) -> None:
    walk.machine.playing = not walk.machine.playing


def daemon(walk: Walk) -> None:
    walk.machine.main_alive = not walk.machine.main_alive


def counter_jumped(walk: Walk) -> None:
    walk.machine.counter = (walk.machine.counter + walk.rng.randint(1, 239)) % 240


def offset_frame(walk: Walk) -> None:
    walk.foreign(walk.rng.choice((0, walk.rng.randint(-819, 819), walk.rng.randint(-(2**24), 2**24))))


def offset_by_sdo(walk: Walk) -> None:
    walk.foreign(walk.rng.randint(-900, 900), 0x601)


HAPPENINGS: tuple[tuple[str, Callable[[Walk], None]], ...] = (
    *[("armed anew", armed)] * 6,
    *[("guard restarted", restarted)] * 2,
    *[("foreign offset frame", offset_frame)] * 2,
    ("foreign offset by SDO", offset_by_sdo),
    *[("forged TPDO3", forged)] * 2,
    *[("TPDO lost", lost_tpdo)] * 2,
    ("TPDO3 remapped", drive(remapped=(True, False))),
    ("garbage", garbage),
    ("late cycles", cycles(late=True)),
    ("frames that did not leave", cycles(left=False)),
    ("NC silent", cycles(nc=False)),
    ("SYNC silent", no_sync),
    ("SYNC counter jumped", counter_jumped),
    ("drive's state", drive(statusword=(ENABLED, 0x0237, 0x1A37, 0x3237, 0x0008), mode=(8, 8, 1))),
    ("drive silent", drive(answers=(True, False))),
    ("drive scales its offset", drive(scale=(0.0, 0.5, 1.0))),
    ("following error", drive(position_error=(0, 100, 20000))),
    ("drive rebooted", rebooted),
    ("set-up written by SDO", written),
    ("bus error state", error_state),
    ("path jumped", jumped),
    ("feed held", stands),
    ("daemon gone or back", daemon),
    *[("request", requested)] * 3,
)


def episode(seed: str) -> tuple[Counter[str], list[str]]:
    """Run one walk; what happened how often, and what was wrong."""
    walk = Walk(random.Random(seed))
    walk.run()
    return walk.seen, [f"seed {seed}: {each}" for each in walk.wrong[:3]]


def walks(sync: int, seed: int, processes: int) -> tuple[Counter[str], list[str]]:
    """Run enough episodes for ``sync`` SYNC."""
    seen, wrong = Counter[str](), list[str]()
    seeds: Iterator[str] = (f"{seed}:{k}" for k in range(-(-sync // EPISODE)))
    with ProcessPoolExecutor(processes) as pool:
        for counted, found in pool.map(episode, seeds, chunksize=8):
            seen += counted
            wrong += found
    return seen, wrong


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return what happened how often, and the frames that broke a limit."""
    seen, wrong = walks(options.sync, options.seed, options.processes)
    return {"counts": dict(sorted(seen.items())), "violations": wrong}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page; its conclusion follows from the figures."""
    seen, wrong = figures["counts"], figures["violations"]
    count = f"{len(wrong)} frames broke a limit" if wrong else "no frame broke a limit"
    lines = pages.head("The guard's invariants on random buses", "guard_invariants", run)
    lines += pages.paragraph(
        f"{seen['sync']:,} SYNC of one axis at random, {seen['frames']:,} offset frames sent: **{count}**."
    )
    lines += pages.paragraph(
        f"""Each episode of some {EPISODE:,} SYNC begins with a guard that starts beside a drive that holds nothing, an
        offset within 250 um, or anything, with a commissioning record that holds, is void or is missing. Every frame is
        judged by the wire and by what the drive held, not by the guard's own state: it must be within 250 um, go on
        from the last frame on the wire (anybody's) or from the value in the drive within rate and acceleration, and
        travel no more in a second than allowed, two ramps apart. Nothing may be sent in OFF or FROZEN."""
    )
    happened = [[name, f"{seen.get(name, 0):,}"] for name in dict(HAPPENINGS)]
    moves = [[name, f"{times:,}"] for name, times in seen.items() if " to " in name]
    lines += [*pages.grid(("what happened", "times"), happened), ""]
    lines += [*pages.grid(("the guard's states", "times"), moves), ""]
    return "\n".join([*lines, *(f"* {each}" for each in wrong[:20])])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sync", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    figures = pages.conduct("guard_invariants", parser, lambda options: str(options.seed), measure)
    sys.exit(bool(figures["violations"]))


if __name__ == "__main__":
    main()
