"""The emergency ramp after a failure of the loop: each of its frames, and its end."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace

import pytest

from fdhil.guard.can_socket import Frame
from fdhil.guard.emergency_ramp import ramp_to_zero
from fdhil.guard.event_journal import SYSTEM
from fdhil.guard.feedforward_law import arm_feedforward
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import GuardState, make_initial_state
from fdhil.guard.offset_limits import move_toward_goal
from tests.guard import simulated_bus
from tests.guard.feedforward_machine import LAW, fed_settings
from tests.guard.guard_rig import Wire

SYNC: Frame = (0x080, b"", 0.0)
LAST_ZEROS = 5


class Ticking(Wire):
    def __init__(self, made: GuardSettings, fulls: Sequence[int] = ()) -> None:
        super().__init__(made.sent_ids)
        self.syncs, self._fulls = 0, fulls
        self.feed([SYNC])

    def receive(self) -> list[Frame]:
        frames = super().receive()
        self.syncs += 1
        self.full = self.syncs in self._fulls
        self.feed([SYNC])
        return frames

    def offsets(self, node: int) -> list[int]:
        return [struct.unpack("<i", data)[0] for cob_id, data in self.sent if cob_id == 0x300 + node]


def sending(made: GuardSettings, *offsets: int, rate: int = 0, mode: Mode = Mode.ACTIVE) -> GuardState:
    state = make_initial_state(made)
    axes = [axis._replace(offset=offset, rate=rate) for axis, offset in zip(state.axes, offsets, strict=True)]
    return state._replace(mode=mode, axes=tuple(axes))


def ramp(offset: int, rate: int, fulls: Sequence[int] = ()) -> Iterator[int]:
    syncs = 0
    while True:
        syncs += 1
        after = move_toward_goal(simulated_bus.LIMITS, offset, rate, 0, 0)
        if syncs in fulls:
            rate = 0
        else:
            offset, rate = after, after - offset
            yield after


@pytest.mark.parametrize(("rate", "fulls"), [(0, ()), (40, ()), (-40, (3, 4)), (0, (1, 20))])
def test_emergency_ramp_keeps_the_limits_and_ends_after_five_zeros(rate: int, fulls: Sequence[int]) -> None:
    made = simulated_bus.settings()
    wire = Ticking(made, fulls)
    try:
        assert ramp_to_zero(sending(made, 600, -200, rate=rate), (), made, wire, SYSTEM) == (0, 0)
    finally:
        wire.close()
    for node, offset in ((1, 600), (2, -200)):
        sent = wire.offsets(node)
        assert sent == [value for value, _ in zip(ramp(offset, rate, fulls), sent, strict=False)]
    last = [k for k, pair in enumerate(zip(wire.offsets(1), wire.offsets(2), strict=True)) if any(pair)][-1]
    assert len(wire.offsets(1)) - 1 - last == LAST_ZEROS


def test_emergency_ramp_starts_from_the_previous_offset_of_an_unsent_axis() -> None:
    made = simulated_bus.settings()
    state = sending(made, 600, -200, rate=40)
    axes = (state.axes[0]._replace(sent=(600, 560, 520, 480)), state.axes[1])
    wire = Ticking(made)
    try:
        assert ramp_to_zero(state._replace(axes=axes), (0,), made, wire, SYSTEM) == (0, 0)
    finally:
        wire.close()
    for node, offset, rate in ((1, 560, 0), (2, -200, 40)):
        sent = wire.offsets(node)
        assert sent == [value for value, _ in zip(ramp(offset, rate, ()), sent, strict=False)]


def test_emergency_ramp_waits_for_each_sync_on_the_wall_clock() -> None:
    made = replace(simulated_bus.settings(), clock="monotonic", sync_period_s=0.2)
    assert 0.5 < made.silence_s < 1
    wire = Ticking(made)
    try:
        assert ramp_to_zero(sending(made, 0, 0), (), made, wire, SYSTEM) == (0, 0)
    finally:
        wire.close()
    assert wire.offsets(1) == [0] * LAST_ZEROS


def test_emergency_ramp_sends_nothing_when_nothing_was_sent() -> None:
    made = fed_settings()
    wire = Ticking(made)
    try:
        assert ramp_to_zero(sending(made, 0, 0, mode=Mode.OFF), (), made, wire, SYSTEM) == (0, 0)
    finally:
        wire.close()
    assert (wire.syncs, wire.sent) == (0, [])


@pytest.mark.parametrize(("mode", "fed"), [(Mode.ACTIVE, False), (Mode.OFF, True), (Mode.ACTIVE, True)])
def test_emergency_ramp_zeroes_only_sent_objects(mode: Mode, fed: bool) -> None:
    made = fed_settings()
    state = sending(made, 0, 0, mode=mode)
    wire = Ticking(made)
    try:
        ramp_to_zero(state._replace(feed=arm_feedforward((LAW, LAW))) if fed else state, (), made, wire, SYSTEM)
    finally:
        wire.close()
    wanted = [*([0x301, 0x302] if mode is Mode.ACTIVE else []), *([0x401, 0x402] if fed else [])]
    assert [cob_id for cob_id, _ in wire.sent] == wanted * LAST_ZEROS
    assert not any(byte for _, data in wire.sent for byte in data)
