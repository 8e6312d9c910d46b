"""The invariants of the safety page on the trace of frames, with faults in any order at any time."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import hypothesis.strategies as st
import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from fdhil.guard.guard_protocol import IN_CHARGE, ON_PATH, SENDING, Mode
from fdhil.guard.guard_state import GuardRequest
from studies.guard_invariants import episode
from tests.guard.frame_checks import CEILING, Wire
from tests.guard.simulated_bus import ENABLED, RECORD, Bench, arm_request, bench

pytestmark = pytest.mark.usefixtures("long_computation")

NODES = st.sampled_from((0, 1))
VALUES = st.one_of(st.integers(-CEILING, CEILING), st.integers(-(2**24), 2**24))
AUTOMATIC = {
    **{mode: {Mode.RAMP_DOWN, Mode.OFF, Mode.FROZEN} for mode in SENDING},
    Mode.OFF: {Mode.ADOPT, Mode.FROZEN},
    Mode.FROZEN: set(),
}
AUTOMATIC[Mode.ARMED] |= ON_PATH
for _mode in ON_PATH:
    AUTOMATIC[_mode] |= ON_PATH


def test_random_walks_break_no_limit() -> None:
    """A sample of the study ``python -m studies.guard_invariants``."""
    frames = 0
    for seed in range(4):
        seen, wrong = episode(f"suite:{seed}")
        assert wrong == []
        frames += seen["frames"]
    assert frames > 3000


class Faults(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.machine: Bench = bench()
        self.wires = [Wire(axis.limits, 0) for axis in self.machine.settings.axes]

    @initialize(held=st.tuples(VALUES, VALUES))
    def start_with_offsets_in_the_drives(self, held: tuple[int, int]) -> None:
        self.wires = [Wire(axis.limits, value) for axis, value in zip(self.machine.settings.axes, held, strict=True)]
        for drive, value in zip(self.machine.drives, held, strict=True):
            drive.hold(value)

    def cycle(self, request: GuardRequest | None = None, unsent: Sequence[int] = (), **how: object) -> None:
        machine, before = self.machine, self.machine.mode
        if machine.outputs and machine.outputs[-1].offsets is not None:
            for k in unsent:
                self.wires[k].lost()
        output = machine.run_sync(request, unsent=unsent, **how)  # type: ignore[arg-type] # keywords of sync
        after = machine.mode
        if after is not before:
            granted = {Mode.ARMED, Mode.ADOPT, Mode.OFF} if request is not None else set()
            assert after in AUTOMATIC[before] | granted, (before, after)
        assert not (output.heartbeat and output.offsets is None)
        if output.offsets is None:
            for wire in self.wires:
                wire.nothing()
            return
        assert not how.get("late")
        assert before in SENDING or after in SENDING
        for wire, drive, offset in zip(self.wires, machine.drives, output.offsets, strict=True):
            assert wire.ours(offset, drive.offset) is None, (before, after)

    @rule(cycles=st.integers(1, 60))
    def steady(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle()

    @rule()
    def settle_and_arm(self) -> None:
        for drive in self.machine.drives:
            drive.statusword, drive.mode, drive.answers, drive.scale, drive.position_error = ENABLED, 8, True, 1.0, 0
            drive.remapped = False
        self.machine.main_alive = True
        self.machine.rest, self.machine.playing, self.machine.row = None, False, 0
        self.cycle()
        self.cycle(self.comparison(True, RECORD))
        self.machine.receive_frames(0x701, b"\x05")
        self.machine.receive_frames(0x702, b"\x05")
        for _ in range(40):
            self.cycle()
        self.cycle(GuardRequest("adopt", token_valid=True))
        for _ in range(140):
            self.cycle()
        self.cycle(arm_request())
        for _ in range(20):
            self.cycle()
        self.machine.playing = True
        for _ in range(60):
            self.cycle()

    @rule(cycles=st.integers(1, 40))
    @precondition(lambda self: self.machine.mode in ON_PATH)
    def into_the_cut(self, cycles: int) -> None:
        for _ in range(cycles * 8):
            self.cycle()

    @rule()
    def disarm(self) -> None:
        self.cycle(GuardRequest("disarm"))
        assert self.machine.mode not in IN_CHARGE

    @rule(valid=st.booleans())
    def adopt(self, valid: bool) -> None:
        before = self.machine.mode
        self.cycle(GuardRequest("adopt", token_valid=valid))
        assert valid or self.machine.mode is before or self.machine.mode is not Mode.ADOPT

    @rule(valid=st.booleans())
    def arm_at_any_time(self, valid: bool) -> None:
        before = self.machine.mode
        self.cycle(arm_request(token_valid=valid))
        assert valid or before is Mode.ARMED or self.machine.mode is not Mode.ARMED

    @rule(node=NODES, word=st.sampled_from((0x1237, 0x0237, 0x1A37, 0x3237, 0x0008, 0x0250, 0x0007)))
    def statusword(self, node: int, word: int) -> None:
        self.machine.drives[node].statusword = word

    @rule(node=NODES, mode=st.sampled_from((8, 1, 0)))
    def mode_of_operation(self, node: int, mode: int) -> None:
        self.machine.drives[node].mode = mode

    @rule(node=NODES, answers=st.booleans())
    def silent_drive(self, node: int, answers: bool) -> None:
        self.machine.drives[node].answers = answers

    @rule(node=NODES, error=st.integers(-20000, 20000))
    def following_error(self, node: int, error: int) -> None:
        self.machine.drives[node].position_error = error

    @rule(node=NODES, scale=st.sampled_from((0.0, 0.5, 1.0)))
    def drive_scales_its_offset(self, node: int, scale: float) -> None:
        self.machine.drives[node].scale = scale

    @rule(cycles=st.integers(1, 20))
    def late_cycles(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle(late=True)

    @rule(cycles=st.integers(1, 8), unsent=st.sampled_from(((0,), (1,), (0, 1))))
    def frames_do_not_leave(self, cycles: int, unsent: tuple[int, ...]) -> None:
        for _ in range(cycles):
            self.cycle(unsent=unsent)

    @rule(cycles=st.integers(1, 14))
    def nc_pauses(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle(nc=False)

    @rule(cycles=st.integers(1, 6), node=st.sampled_from((0x181, 0x282)))
    def lost_feedback(self, cycles: int, node: int) -> None:
        for _ in range(cycles):
            self.cycle(drop=(node,))

    @rule(node=NODES, code=st.sampled_from((0x0000, 0x8130, 0x7500)), size=st.integers(0, 8))
    def emergency(self, node: int, code: int, size: int) -> None:
        self.machine.receive_frames(0x081 + node, struct.pack("<H6x", code)[:size])

    @rule(node=NODES, state=st.sampled_from((0x04, 0x05, 0x7F)))
    def heartbeat(self, node: int, state: int) -> None:
        self.machine.receive_frames(0x701 + node, bytes([state]))

    @rule(command=st.sampled_from((1, 2, 0x80, 0x81)), node=st.sampled_from((0, 1, 9)))
    def nmt(self, command: int, node: int) -> None:
        self.machine.receive_frames(0x000, bytes([command, node]))

    @rule(node=NODES, value=VALUES, by_sdo=st.booleans())
    def foreign_offset(self, node: int, value: int, by_sdo: bool) -> None:
        sdo = struct.pack("<BHBi", 0x23, 0x60B0, 0, value)
        self.machine.inject_frame(0x601 + node if by_sdo else 0x301 + node, sdo if by_sdo else struct.pack("<i", value))
        self.wires[node].foreign(value)

    @rule(data=st.binary(max_size=8))
    def foreign_heartbeat(self, data: bytes) -> None:
        self.machine.receive_frames(0x764, data)

    @rule(node=NODES, shown=VALUES, demand=VALUES, apart=st.lists(st.sampled_from((0, 1, 9, 10)), max_size=4))
    def forged_read_back(self, node: int, shown: int, demand: int, apart: list[int]) -> None:
        for cycles in (0, *apart):
            for _ in range(cycles):
                self.cycle()
            self.machine.receive_frames(0x381 + node, struct.pack("<ii", demand, shown))

    @rule(node=NODES, remapped=st.booleans())
    def remapped_read_back(self, node: int, remapped: bool) -> None:
        self.machine.drives[node].remapped = remapped

    @rule(node=NODES, cycles=st.sampled_from((5, 25, 80)))
    def lost_read_back(self, node: int, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle(drop=(0x381 + node,))

    @rule()
    def guard_restarts(self) -> None:
        old = self.machine
        self.machine = Bench(old.settings, old.path, old.demand, old.drives)
        self.machine.tick, self.machine.counter, self.machine.row = old.tick, old.counter, old.row

    @rule(node=NODES)
    def reboot(self, node: int) -> None:
        self.machine.reboot(node)
        self.wires[node].foreign(0)

    @rule(digest=st.sampled_from((RECORD, "")), valid=st.booleans())
    def compared(self, digest: str, valid: bool) -> None:
        self.cycle(self.comparison(valid, digest))

    def comparison(self, valid: bool, digest: str) -> GuardRequest:
        touched = {name: axis.touched for name, axis in zip("XY", self.machine.state.axes, strict=True)}
        return GuardRequest("compared", valid, compared={"X": digest, "Y": RECORD}, touched=touched)

    @rule(cob_id=st.sampled_from((0x181, 0x281, 0x381, 0x481, 0x201)), data=st.binary(max_size=8))
    def garbage(self, cob_id: int, data: bytes) -> None:
        self.machine.receive_frames(cob_id, data)

    @rule(jump=st.integers(1, 239))
    def sync_counter_jumps(self, jump: int) -> None:
        self.machine.counter = (self.machine.counter + jump) % 240
        self.cycle()

    @rule()
    def daemon_dies(self) -> None:
        self.machine.main_alive = False
        self.cycle()
        assert self.machine.mode not in IN_CHARGE

    @rule(rows=st.integers(-30, 30))
    def path_jumps(self, rows: int) -> None:
        self.machine.row = max(0, self.machine.row + rows)

    @rule()
    def silence(self) -> None:
        before = self.machine.mode
        output = self.machine.silence()
        assert output.offsets is None
        assert self.machine.mode in AUTOMATIC[before] | {before}
        assert self.machine.mode not in SENDING


Faults.TestCase.settings = hypothesis_settings(max_examples=25, stateful_step_count=20, deadline=None, derandomize=True)
TestFaults = Faults.TestCase
