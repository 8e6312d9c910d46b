"""How the core computes and checks one frame, and how long it waits: rules at their exact limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fdhil.guard import core
from fdhil.guard.interlocks import Alarm
from fdhil.guard.limits import Travel, ceiling
from fdhil.guard.path import CorrectedPath, Place
from fdhil.guard.protocol import Mode
from fdhil.guard.state import AxisState, BusView, Inputs, Request, State, initial
from tests.guard import machine
from tests.guard.machine import DIGEST, bench

MADE = machine.settings("X")
CEILING = 819
"""Increments within 250 um."""


def one(mode: Mode = Mode.ACTIVE, **changes: Any) -> State:
    state = initial(MADE)._replace(mode=mode, places=(Place(1),))
    return state._replace(axes=(state.axes[0]._replace(**changes),))


def table(*offsets: int) -> CorrectedPath:
    return CorrectedPath(0, ([0] * len(offsets),), (offsets,), True, DIGEST)


def test_at_the_start_nothing_is_known_and_zeros_are_remembered_for_as_long_as_a_drive_may_take() -> None:
    axes = [replace(MADE.axes[0], setpoint_delay_cycles=delay, record_void=delay > 1) for delay in (0, 1, 2, 3)]
    state = initial(replace(MADE, axes=tuple(axes)))
    assert state.mode is Mode.OFF
    assert [axis.sent for axis in state.axes] == [(0,) * 4, (0,) * 5, (0,) * 6, (0,) * 7]
    assert [axis.record_void for axis in state.axes] == [False, False, True, True]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_frame_may_be_at_the_ceiling_and_no_increment_beyond(sign: int) -> None:
    assert ceiling(MADE.axes[0].increments_per_mm) == CEILING
    wide = replace(MADE.axes[0].limits, offset=CEILING + 5)
    settings = replace(MADE, axes=(replace(MADE.axes[0], limits=wide),))
    state = one(offset=sign * (CEILING - 1), rate=sign)
    assert core._wrong_frame(state, (sign * CEILING,), settings) is None
    expected = f"{sign * (CEILING - 1)} + {sign} -> {sign * (CEILING + 1)}"
    assert core._wrong_frame(state, (sign * (CEILING + 1),), settings) == Alarm("InternalError", "X", expected)


def test_a_table_that_asks_for_more_than_the_motion_gives_is_told_by_what_it_breaks() -> None:
    """A step that passes the check (its acceleration includes rounding) but exceeds the motion."""
    for goal, code in ((8, "OffsetRate"), (9, "OffsetRate"), (100, "OffsetRate"), (CEILING + 1, "OffsetLimit")):
        assert core._next_offsets(one(), table(0, goal, goal), MADE) == ((), Alarm(code, "X"))
    assert core._next_offsets(one(Mode.RAMPING), table(0, 8, 8), MADE)[1] is None


def test_a_second_of_travel_may_be_all_that_is_allowed() -> None:
    variation = MADE.axes[0].limits.variation
    for travelled, alarm in ((variation, None), (variation + 1, Alarm("OffsetEnergy", "X"))):
        state = one(travel=Travel(current=travelled))
        assert core._next_offsets(state, table(0, 0, 0), MADE)[1] == alarm


def test_where_nothing_is_sent_in_time_the_offset_stands() -> None:
    state = one(Mode.RAMP_DOWN, offset=300, rate=-20, sent=(300, 320, 340, 360))
    state, output = core._move(state, Inputs(True, (), BusView(), late=True), MADE)
    axis = state.axes[0]
    assert (output.offsets, axis.offset, axis.rate, axis.sent) == (None, 300, 0, (300, 300, 320, 340))


def test_arming_begins_at_rest_at_zero_whatever_is_remembered() -> None:
    rubbish = one(Mode.OFF, offset=5, rate=5, sent=(5, 5, 5, 5), echo_misses=1, zero_shown=True)
    armed = core._armed(rubbish, Inputs(True, (), BusView(), path=table(0, 0, 0)))
    assert (armed.mode, armed.axes) == (Mode.ARMED, (AxisState(),))


@pytest.mark.parametrize(("code", "cycles"), [("FeedHold", 10_000), ("Misaligned", 10), ("TargetLost", 10)])
def test_a_feed_hold_lasts_ten_seconds_and_any_other_ten_cycles(code: str, cycles: int) -> None:
    for held_for, mode in ((cycles - 1, Mode.HOLD), (cycles, Mode.RAMP_DOWN)):
        state = core._held(one()._replace(held_for=held_for), Alarm(code), MADE)
        assert (state.mode, state.cause) == (mode, Alarm(code))


def test_a_landing_that_is_begun_anew_counts_its_zeros_anew() -> None:
    state = core._ramp_down(one(Mode.HOLD)._replace(zeros_sent=50), Alarm("Disarmed"))
    assert (state.mode, state.zeros_sent, state.places) == (Mode.RAMP_DOWN, 0, ())


def test_who_is_armed_and_disarmed_is_off_with_what_it_is_known_to_hold() -> None:
    made = bench()
    made.settle()
    assert made.arm() == ()
    made.run(25)
    made.sync(Request("disarm"))
    made.until(Mode.OFF)
    assert [(axis.offset, axis.readings >= 3, axis.zero_shown) for axis in made.state.axes] == [(0, True, True)] * 2
