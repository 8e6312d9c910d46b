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
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

from fdhil.guard.feedforward_law import Pair
from fdhil.guard.guard_protocol import SENDING, FeedMode, Mode
from fdhil.guard.guard_state import GuardRequest, StepOutput
from studies import pages
from tests.guard.feedforward_machine import LIMITS as FED
from tests.guard.feedforward_machine import fed_settings
from tests.guard.feedforward_machine import request as feed_request
from tests.guard.frame_checks import Wire
from tests.guard.simulated_bus import ENABLED, RECORD, Bench, arm_request, bench

EPISODE = 5000
AXES = ("X", "Y")
ADOPT = GuardRequest("adopt", True)
FORGETS: Pair = (0, 0)


class FedWire:
    """Checks the speed and torque offsets to one drive by the frames on the wire: ``ours`` returns the violation."""

    def __init__(self) -> None:
        self.last = self.before = FORGETS

    def lost(self) -> None:
        """The last frame did not leave."""
        self.last = self.before

    def ours(self, pair: Pair) -> str | None:
        """Check a frame of the guard: inside the limits, and each value zero or no more than its rate from the last."""
        before = self.before = self.last
        self.last = pair
        bounds = ((FED.speed, FED.speed_rate), (FED.torque, FED.torque_rate))
        for value, last, (largest, rate) in zip(pair, before, bounds, strict=True):
            if type(value) is not int or not abs(value) <= largest:
                return f"speed or torque offset {value!r}: beyond the largest"
            if value != 0 and not abs(value - last) <= rate:
                return f"speed or torque offset {last} -> {value}: a step"
        return None


@dataclass
class Walk:
    """One machine of two axes from the guard's start on, ``EPISODE`` SYNC of it; ``wrong`` broke a limit.

    Half of them may send speed and torque offsets as well, a fifth have drives that take offsets without SYNC.
    """

    rng: random.Random
    machine: Bench = field(init=False)
    wires: list[Wire] = field(init=False)
    fed: bool = field(init=False)
    fed_wires: list[FedWire] = field(init=False)
    seen: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    drop: dict[int, int] = field(default_factory=dict)
    mode: Mode = Mode.OFF

    def __post_init__(self) -> None:
        rng = self.rng
        made = bench(amplitude=rng.choice((100, 300, 800)), offset_synchronous=rng.random() < 0.8)
        self.fed, shown = rng.random() < 0.5, rng.random() < 0.5
        own = fed_settings(shown).axes if self.fed else made.settings.axes
        axes = [replace(axis, record=rng.choice((*[RECORD] * 5, "")), record_void=rng.random() < 0.05) for axis in own]
        self.machine = Bench(replace(made.settings, axes=tuple(axes)), made.path, made.demand, made.drives)
        self.wires, self.fed_wires = [], [FedWire() for _ in axes]
        for axis, drive in zip(axes, self.machine.drives, strict=True):
            held = rng.choice((0, 0, rng.randint(-819, 819), rng.randint(-819, 819), rng.randint(-(2**24), 2**24)))
            drive.hold(held)
            drive.shows_fed = self.fed and shown
            self.wires.append(Wire(axis.limits, held))

    @property
    def node(self) -> int:
        """One of the drives, 0 or 1."""
        return self.rng.randrange(len(AXES))

    def cycle(
        self, request: GuardRequest | None = None, late: bool = False, unsent: Sequence[int] = (), nc: bool = True
    ) -> None:
        """Run one SYNC and check its frames. ``unsent``: the axes whose frames of the step before were not sent."""
        machine = self.machine
        if unsent and machine.outputs:
            self._not_left(machine.outputs[-1], unsent)
        machine.outputs, machine.frames, machine.held = machine.outputs[-1:], machine.frames[-1:], []
        dropped = tuple([cob_id for cob_id, until in self.drop.items() if machine.tick < until])
        output = machine.run_sync(request, late=late, unsent=unsent, nc=nc, drop=dropped)
        self.seen["sync"] += 1
        self.judge(output, late)

    def _not_left(self, output: StepOutput, unsent: Sequence[int]) -> None:
        for k in unsent:
            if output.offsets is not None:
                self.wires[k].lost()
            if output.feed is not None:
                self.machine.drives[k].received_fed = None
                self.fed_wires[k].lost()

    def judge(self, output: StepOutput, late: bool) -> None:
        """Check the frames sent at a SYNC, or at the local timer without one."""
        machine, before, self.mode = self.machine, self.mode, self.machine.mode
        if self.mode is not before:
            self.seen[f"{before.value} to {self.mode.value}"] += 1
        wrong: list[str | None] = []
        if output.feed is not None:
            self.seen["fed frames"] += len(AXES)
            self.seen["fed frames that are not zero"] += sum(map(any, output.feed))
            wrong += [wire.ours(pair) for wire, pair in zip(self.fed_wires, output.feed, strict=True)]
            if output.offsets is not None and any(map(any, output.feed)):
                wrong.append("speed or torque offsets beside a position offset")
        if output.offsets is None:
            for wire in self.wires:
                wire.nothing()
        else:
            self.seen["frames"] += len(AXES)
            frames = zip(self.wires, output.offsets, machine.drives, strict=True)
            wrong += [wire.ours(offset, drive.offset) for wire, offset, drive in frames]
            if not {before, self.mode} & SENDING:
                wrong.append("a frame that nobody armed")
        if late and (output.offsets is not None or output.feed is not None):
            wrong.append("a frame that is too late")
        where = f"SYNC {machine.tick}, {before.value} to {self.mode.value}"
        self.wrong += [f"{where}: {each}" for each in wrong if each is not None]

    def run(self) -> None:
        """Let things happen, with quiet between them and every now and then all that it takes to be armed."""
        while self.seen["sync"] < EPISODE:
            name, happen = self.rng.choice(HAPPENINGS)
            self.seen[name] += 1
            happen(self)
            for _ in range(self.rng.choice((0, 1, 5, 20, 60))):
                self.cycle()

    def foreign(self, value: int, service: int = 0x301) -> None:
        """Another node writes the offset of a drive, by our COB-ID or by SDO."""
        node = self.node
        data = struct.pack("<i", value) if service == 0x301 else struct.pack("<BHBi", 0x23, 0x60B0, 0, value)
        self.machine.inject_frame(service + node, data)
        self.wires[node].foreign(value)


def compared(walk: Walk, valid: bool = True) -> GuardRequest:
    """Both drives were compared now, and found as they were commissioned."""
    touched = {name: axis.touched for name, axis in zip(AXES, walk.machine.state.axes, strict=True)}
    return GuardRequest("compared", valid, compared=dict.fromkeys(AXES, RECORD), touched=touched)


def armed(walk: Walk) -> None:
    """Restore a valid state: compared, residual offsets adopted, armed and on the path."""
    machine = walk.machine
    for drive in machine.drives:
        drive.statusword, drive.mode, drive.answers, drive.scale, drive.position_error = ENABLED, 8, True, 1.0, 0
        drive.remapped, drive.takes_fed = False, lambda pair: pair
        machine.receive_frames(0x700 + drive.node_id, b"\x05")
    walk.drop.clear()
    machine.listener.set_controller_state("active")
    machine.main_alive, machine.rest, machine.playing, machine.row = True, None, False, 0
    arm = feed_request() if walk.fed and walk.rng.random() < 0.6 else arm_request()
    walk.cycle()
    for request in (compared(walk), None, ADOPT, None, arm):
        walk.cycle(request)
        for _ in range(45):
            walk.cycle()
    for _ in range(20):
        off = machine.mode is Mode.OFF and machine.state.feed.mode is FeedMode.OFF
        walk.cycle(arm if off else None)
    machine.playing = True
    for _ in range(walk.rng.randint(20, 400)):
        walk.cycle()


def restarted(walk: Walk) -> None:
    """Kill the guard; the next one has no state, the drive keeps its offset."""
    machine = walk.machine
    again = Bench(machine.settings, machine.path, machine.demand, machine.drives)
    again.tick, again.counter, again.row = machine.tick, machine.counter, machine.row
    walk.machine, walk.mode = again, Mode.OFF
    for wire in walk.fed_wires:
        wire.last = FORGETS  # where none is shown it begins at zero, whatever the drive holds


def not_left(walk: Walk) -> None:
    """The frames of one axis, or of both, do not leave for a few cycles."""
    cycles(unsent=walk.rng.choice(((0,), (1,), (0, 1))))(walk)


def cycles(**how: Any) -> Callable[[Walk], None]:
    """Return a happening of a few cycles that are not as they should be."""

    def happen(walk: Walk) -> None:
        for _ in range(walk.rng.randint(1, 15)):
            walk.cycle(**how)

    return happen


def drive(**values: tuple[object, ...]) -> Callable[[Walk], None]:
    """Return a happening in which the drive becomes something of this."""

    def happen(walk: Walk) -> None:
        for name, among in values.items():
            setattr(walk.machine.drives[walk.node], name, walk.rng.choice(among))

    return happen


def forged(walk: Walk) -> None:
    """TPDO3 as another node would make it, once or some times, now and then right behind the drive's own."""
    value = walk.rng.choice((walk.rng.randint(-819, 819), walk.rng.randint(-(2**31), 2**31 - 1)))
    node = walk.node
    for _ in range(walk.rng.choice((1, 1, 2, 3, 12))):
        walk.machine.receive_frames(0x381 + node, struct.pack("<ii", walk.rng.choice((value, 0)), value))
        for _ in range(walk.rng.choice((0, 1, 1, 9, 10))):
            walk.cycle()


def garbage(walk: Walk) -> None:
    """Any bytes under a COB-ID that the guard listens to."""
    cob_id = walk.rng.choice((0x181, 0x281, 0x381, 0x481, 0x1A1, 0x201, 0x000, 0x081, 0x701, 0x401, 0x764))
    walk.machine.receive_frames(cob_id, walk.rng.randbytes(walk.rng.randint(0, 8)))


def lost_tpdo(walk: Walk) -> None:
    cob_id = walk.node + walk.rng.choice((0x181, 0x281, 0x381, 0x381, 0x481, 0x1A1))
    walk.drop[cob_id] = walk.machine.tick + walk.rng.choice((1, 12, 25, 200))


def rebooted(walk: Walk) -> None:
    node = walk.node
    walk.machine.reboot(node)
    walk.wires[node].foreign(0)


def requested(walk: Walk) -> None:
    """Send any request at any time, including one to arm a method that is not allowed with the active one."""
    valid = walk.rng.random() < 0.8
    kind = walk.rng.choice(("arm", "feedforward", "disarm", "adopt", "adopt", "stop", "compared"))
    if kind == "compared":
        walk.cycle(compared(walk, valid))
    elif kind in ("arm", "feedforward"):
        walk.cycle((arm_request if kind == "arm" else feed_request)(token_valid=valid))
    else:
        walk.cycle(GuardRequest(kind, valid))


def no_sync(walk: Walk) -> None:
    """The local timer, again and again; nothing leaves but zeros where the drives wait for SYNC."""
    for _ in range(walk.rng.choice((1, 1, 10, 100))):
        output = walk.machine.silence()
        if output.offsets is not None and walk.machine.settings.offset_synchronous:
            walk.wrong.append("a frame without SYNC")
        walk.judge(output, late=False)


def error_state(walk: Walk) -> None:
    walk.machine.listener.set_controller_state(walk.rng.choice(("active", "warning", "passive", "off", "restarted")))


def written(walk: Walk) -> None:
    walk.machine.receive_frames(
        0x601 + walk.node, struct.pack("<BHBI", 0x23, walk.rng.choice((0x6065, 0x1A02, 0x6060)), 0, 0)
    )


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
    *[("armed again", armed)] * 6,
    *[("guard restarted", restarted)] * 2,
    *[("foreign offset frame", offset_frame)] * 2,
    ("foreign offset by SDO", offset_by_sdo),
    *[("forged TPDO3", forged)] * 2,
    *[("TPDO lost", lost_tpdo)] * 2,
    ("TPDO3 remapped", drive(remapped=(True, False))),
    ("garbage", garbage),
    ("late cycles", cycles(late=True)),
    ("frames that did not leave", not_left),
    ("NC silent", cycles(nc=False)),
    ("SYNC silent", no_sync),
    ("SYNC counter jumped", counter_jumped),
    ("drive's state", drive(statusword=(ENABLED, 0x0237, 0x1A37, 0x3237, 0x0008), mode=(8, 8, 1))),
    ("drive silent", drive(answers=(True, False))),
    ("drive ignores speed offsets", drive(takes_fed=(lambda pair: pair, lambda _pair: (0, 0)))),
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
    met = not wrong and seen["sync"] >= 10_000_000
    reported = (
        f"{len(wrong)} in {seen['sync']:,} SYNC of two axes at random ({seen['frames'] + seen['fed frames']:,} frames)"
    )
    goals = {"R3": {"met": met, "figure": reported}}
    return {"counts": dict(sorted(seen.items())), "violations": wrong, "goals": goals}


def page(run: pages.Run, figures: Mapping[str, Any]) -> str:
    """Return the study's page; its conclusion follows from the figures."""
    seen, wrong = figures["counts"], figures["violations"]
    count = f"{len(wrong)} frames broke a limit" if wrong else "no frame broke a limit"
    lines = pages.write_head("The guard's invariants on random buses", "guard_invariants", run)
    lines += pages.wrap_paragraph(
        f"""{seen["sync"]:,} SYNC of two axes at random, {seen["frames"]:,} frames with position offsets and
        {seen["fed frames"]:,} with speed and torque offsets sent ({seen["fed frames that are not zero"]:,} of them not
        zero): **{count}**."""
    )
    lines += pages.wrap_paragraph(
        f"""Each episode of some {EPISODE:,} SYNC begins with a guard that starts beside a drive that holds nothing, an
        offset within 250 um, or anything, with a commissioning record that holds, is void or is missing. Every frame is
        judged by the wire and by what the drive held, not by the guard's own state: it must be within 250 um, go on
        from the last frame on the wire (anybody's) or from the value in the drive within rate and acceleration, and
        travel no more in a second than allowed, two ramps apart. Nothing may be sent in OFF or FROZEN, and nothing at
        a SYNC that is past. Half of the guards may send speed and torque offsets (0x60B1, 0x60B2): these must be
        within their own limits, zero or within their rate of the last, and zero beside a position offset. A fifth have
        drives that take an offset without SYNC; there the ramp on the local timer is judged in the same way."""
    )
    happened = [[name, f"{seen.get(name, 0):,}"] for name in dict(HAPPENINGS)]
    moves = [[name, f"{times:,}"] for name, times in seen.items() if " to " in name]
    lines += [*pages.write_table(("what happened", "times"), happened), ""]
    lines += [*pages.write_table(("the guard's states", "times"), moves), ""]
    return "\n".join([*lines, *(f"* {each}" for each in wrong[:20])])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sync", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    figures = pages.run_study("guard_invariants", parser, lambda options: str(options.seed), measure)
    sys.exit(bool(figures["violations"]))


if __name__ == "__main__":
    main()
