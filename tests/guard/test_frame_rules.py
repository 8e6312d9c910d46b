"""How the core computes and checks one frame, and how long it waits: rules at their exact limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fdhil.guard import guard_step
from fdhil.guard.corrected_path import CorrectedPath, PathPosition
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import AxisState, BusView, GuardRequest, GuardState, StepInputs, make_initial_state
from fdhil.guard.interlocks import Alarm
from fdhil.guard.offset_limits import OffsetTravel, compute_offset_ceiling
from tests.guard import simulated_bus
from tests.guard.simulated_bus import DIGEST, bench

MADE = simulated_bus.settings("X")
CEILING = 819
"""Increments within 250 um."""


def one(mode: Mode = Mode.ACTIVE, **changes: Any) -> GuardState:
    state = make_initial_state(MADE)._replace(mode=mode, places=(PathPosition(1),))
    return state._replace(axes=(state.axes[0]._replace(**changes),))


def table(*offsets: int) -> CorrectedPath:
    return CorrectedPath(0, ([0] * len(offsets),), (offsets,), True, DIGEST)


def test_initial_state_is_unknown_with_zeros_for_the_longest_drive_delay() -> None:
    axes = [replace(MADE.axes[0], setpoint_delay_cycles=delay, record_void=delay > 1) for delay in (0, 1, 2, 3)]
    state = make_initial_state(replace(MADE, axes=tuple(axes)))
    assert state.mode is Mode.OFF
    assert [axis.sent for axis in state.axes] == [(0,) * 4, (0,) * 5, (0,) * 6, (0,) * 7]
    assert [axis.record_void for axis in state.axes] == [False, False, True, True]


@pytest.mark.parametrize("sign", [1, -1])
def test_frame_at_the_ceiling_passes_and_one_increment_beyond_fails(sign: int) -> None:
    assert compute_offset_ceiling(MADE.axes[0].increments_per_mm) == CEILING
    wide = replace(MADE.axes[0].limits, offset=CEILING + 5)
    settings = replace(MADE, axes=(replace(MADE.axes[0], limits=wide),))
    state = one(offset=sign * (CEILING - 1), rate=sign)
    assert guard_step._check_offset_frames(state, (sign * CEILING,), settings) is None
    expected = f"{sign * (CEILING - 1)} + {sign} -> {sign * (CEILING + 1)}"
    assert guard_step._check_offset_frames(state, (sign * (CEILING + 1),), settings) == Alarm(
        "InternalError", "X", expected
    )


def test_table_beyond_the_limits_is_reported_with_the_broken_limit() -> None:
    """A step that passes the check (its acceleration includes rounding) but exceeds the motion."""
    for goal, code in ((8, "OffsetRate"), (9, "OffsetRate"), (100, "OffsetRate"), (CEILING + 1, "OffsetLimit")):
        assert guard_step._compute_next_offsets(one(), table(0, goal, goal), MADE) == ((), Alarm(code, "X"))
    assert guard_step._compute_next_offsets(one(Mode.RAMPING), table(0, 8, 8), MADE)[1] is None


def test_offset_may_travel_the_allowed_distance_in_one_second() -> None:
    variation = MADE.axes[0].limits.variation
    for travelled, alarm in ((variation, None), (variation + 1, Alarm("OffsetEnergy", "X"))):
        state = one(travel=OffsetTravel(current=travelled))
        assert guard_step._compute_next_offsets(state, table(0, 0, 0), MADE)[1] == alarm


def test_offset_stands_still_when_a_step_is_too_late() -> None:
    state = one(Mode.RAMP_DOWN, offset=300, rate=-20, sent=(300, 320, 340, 360))
    state, output = guard_step._move_offsets(state, StepInputs(True, (), BusView(), late=True), MADE)
    axis = state.axes[0]
    assert (output.offsets, axis.offset, axis.rate, axis.sent) == (None, 300, 0, (300, 300, 320, 340))


def test_arming_starts_from_zero_at_standstill() -> None:
    rubbish = one(Mode.OFF, offset=5, rate=5, sent=(5, 5, 5, 5), echo_misses=1, zero_shown=True)
    armed = guard_step._enter_armed(rubbish, StepInputs(True, (), BusView(), path=table(0, 0, 0)))
    assert (armed.mode, armed.axes) == (Mode.ARMED, (AxisState(),))


@pytest.mark.parametrize(("code", "cycles"), [("FeedHold", 10_000), ("Misaligned", 10), ("TargetLost", 10)])
def test_feed_hold_lasts_ten_seconds_and_other_holds_ten_cycles(code: str, cycles: int) -> None:
    for held_for, mode in ((cycles - 1, Mode.HOLD), (cycles, Mode.RAMP_DOWN)):
        state = guard_step._hold_offset(one()._replace(held_for=held_for), Alarm(code), MADE)
        assert (state.mode, state.cause) == (mode, Alarm(code))


def test_restarted_ramp_down_counts_its_zeros_again() -> None:
    state = guard_step._begin_ramp_down(one(Mode.HOLD)._replace(zeros_sent=50), Alarm("Disarmed"))
    assert (state.mode, state.zeros_sent, state.places) == (Mode.RAMP_DOWN, 0, ())


def test_arm_and_disarm_ends_off_with_confirmed_zero() -> None:
    made = bench()
    made.settle()
    assert made.arm() == ()
    made.run(25)
    made.run_sync(GuardRequest("disarm"))
    made.run_until(Mode.OFF)
    assert [(axis.offset, axis.readings >= 3, axis.zero_shown) for axis in made.state.axes] == [(0, True, True)] * 2
