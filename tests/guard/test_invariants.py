"""The invariants of the safety page on the trace of frames, with faults in any order at any time."""

from __future__ import annotations

import struct

import hypothesis.strategies as st
from hypothesis import settings as hypothesis_settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fdhil.guard.limits import violation
from fdhil.guard.state import IN_CHARGE, LANDING, ON_PATH, SENDING, Mode, Request
from tests.guard.machine import ENABLED, Bench, arm_request, bench

NODES = st.sampled_from((0, 1))
AUTOMATIC = {
    **{mode: {Mode.RAMP_DOWN, Mode.OFF, Mode.FROZEN} for mode in SENDING},
    Mode.OFF: {Mode.ADOPT},
    Mode.FROZEN: set(),
}
AUTOMATIC[Mode.ARMED] |= ON_PATH
for _mode in ON_PATH:
    AUTOMATIC[_mode] |= ON_PATH


class Faults(RuleBasedStateMachine):
    """Any sequence of cycles, requests and faults; ``steady`` cycles in between let the guard get somewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.machine: Bench = bench()
        self.trace: list[tuple[int, ...]] = [(0, 0), (0, 0)]
        self.gaps: list[bool] = [True, True]
        self.fault_at: int | None = None

    def cycle(self, request: Request | None = None, **how: object) -> None:
        """One SYNC, its frame into the trace of what is in force."""
        machine, before = self.machine, self.machine.mode
        was_charged = any(offset for offset in self.trace[-1])
        if how.get("transmitted") is False and machine.outputs and machine.outputs[-1].offsets is not None:
            self.trace[-1] = self.trace[-2]
            self.gaps[-1] = True
        output = machine.sync(request, **how)  # type: ignore[arg-type] # keywords of sync
        self.follow(before, output.offsets, request, was_charged)
        assert not (how.get("late") and output.offsets is not None)
        assert not (output.heartbeat and output.offsets is None)

    def follow(self, before: Mode, offsets: tuple[int, ...] | None, request: Request | None, was_charged: bool) -> None:
        after = self.machine.mode
        if after is not before:
            granted = {Mode.ARMED, Mode.ADOPT} if request is not None else set()
            assert after in AUTOMATIC[before] | granted, (before, after)
        if offsets is None:
            if after is Mode.ADOPT and before is not Mode.ADOPT:
                self.trace.append(tuple(axis.offset for axis in self.machine.state.axes))
            self.trace.append(self.trace[-1])
            self.gaps.append(True)
            return
        assert before in SENDING or after in SENDING
        assert all(type(offset) is int for offset in offsets)
        if after is Mode.ADOPT and before is not Mode.ADOPT:  # what the drive holds is where it starts
            held = tuple(drive.offset for drive in self.machine.drives)
            self.trace += [held, held]
            self.gaps += [True, True]
        for k, axis in enumerate(self.machine.settings.axes):
            last, value = self.trace[-1][k], offsets[k]
            rate = 0 if self.gaps[-1] else last - self.trace[-2][k]
            assert violation(axis.limits, last, rate, value) is None, (before, after, last, rate, value)
        self.trace.append(offsets)
        self.gaps.append(False)

    @rule(cycles=st.integers(1, 60))
    def steady(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle()

    @rule()
    def settle_and_arm(self) -> None:
        """Everything good again, then armed and into the path where that is allowed."""
        for drive in self.machine.drives:
            drive.statusword, drive.mode, drive.answers, drive.scale, drive.position_error = ENABLED, 8, True, 1.0, 0
        self.machine.main_alive = True
        self.machine.rest, self.machine.playing, self.machine.row = None, False, 0
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
        self.cycle(Request("disarm"))
        assert self.machine.mode not in IN_CHARGE

    @rule(valid=st.booleans())
    def adopt(self, valid: bool) -> None:
        before = self.machine.mode
        self.cycle(Request("adopt", token_valid=valid))
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

    @rule(cycles=st.integers(1, 8))
    def frames_do_not_leave(self, cycles: int) -> None:
        for _ in range(cycles):
            self.cycle(transmitted=False)

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
        self.machine.hear(0x081 + node, struct.pack("<H6x", code)[:size])

    @rule(node=NODES, state=st.sampled_from((0x00, 0x04, 0x05, 0x7F)))
    def heartbeat(self, node: int, state: int) -> None:
        self.machine.hear(0x701 + node, bytes([state]))

    @rule(command=st.sampled_from((1, 2, 0x80, 0x81)), node=st.sampled_from((0, 1, 9)))
    def nmt(self, command: int, node: int) -> None:
        self.machine.hear(0x000, bytes([command, node]))

    @rule(cob_id=st.sampled_from((0x301, 0x302, 0x764)), data=st.binary(max_size=8))
    def foreign_frame(self, cob_id: int, data: bytes) -> None:
        self.machine.hear(cob_id, data)

    @rule(cob_id=st.sampled_from((0x181, 0x281, 0x381, 0x481, 0x201)), data=st.binary(max_size=8))
    def garbage(self, cob_id: int, data: bytes) -> None:
        self.machine.hear(cob_id, data)

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

    @invariant()
    def applied_is_what_was_sent(self) -> None:
        """While it sends, the guard's idea of the offset is the last frame of the trace."""
        if self.machine.mode in SENDING - LANDING:
            assert tuple(axis.offset for axis in self.machine.state.axes) == self.trace[-1]


Faults.TestCase.settings = hypothesis_settings(max_examples=25, stateful_step_count=20, deadline=None)
TestFaults = Faults.TestCase
