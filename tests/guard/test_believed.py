"""Rules for trusting and adopting a drive's offset, each by itself, without a machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from fdhil.guard.adoption import (
    adopt_at_start,
    adopt_refusals,
    adopting,
    at_rest,
    at_zero,
    compared,
    doubts,
    frozen,
    in_doubt,
    measure,
    unread,
)
from fdhil.guard.conditions import Views, views_of
from fdhil.guard.interlocks import CATALOGUE, Alarm, Alarms, Reaction
from fdhil.guard.path import Place
from fdhil.guard.protocol import AT_REST, SENDING, FeedMode, Mode
from fdhil.guard.settings import Settings
from fdhil.guard.state import AxisInput, AxisState, BusView, Inputs, Request, State, initial
from tests.guard import machine
from tests.guard.fed import fed_settings
from tests.guard.machine import RECORD

MADE = machine.settings()
GOOD = Inputs(True, (AxisInput(), AxisInput()), BusView())
PATIENCE = 60
"""SYNC: six of the TPDOs that show the offset, one every ten SYNC."""
WAITS = {code for code, row in CATALOGUE.items() if row[0] is Reaction.FREEZE} | {
    *("SyncJitter", "OffsetHijack", "BusLocked")
}
DOUBTS = {"StaleData", "TargetLost", "FollowingError", "Implausible", "PdoLength"}


def held(*shown: int | None, mode: Mode = Mode.OFF, **changes: Any) -> State:
    state = initial(MADE)
    axes = [a._replace(read_back=s, readings=3, **changes) for a, s in zip(state.axes, shown, strict=True)]
    return state._replace(mode=mode, axes=tuple(axes))


def views(state: State, made: Settings = MADE, inputs: Inputs = GOOD) -> Views:
    return views_of(made, inputs, state)


def started(state: State, *alarms: str, inputs: Inputs = GOOD) -> State:
    return adopt_at_start(state, inputs, tuple(map(Alarm, alarms)), views(state, inputs=inputs), MADE)


# --- at the start ---


@pytest.mark.parametrize("code", CATALOGUE)
def test_at_the_start_the_bus_must_be_ours_and_what_is_read_plausible(code: str) -> None:
    before = held(500, 0)
    after = started(before, code)
    if code in WAITS:
        assert after == before
    elif code in DOUBTS:
        assert after == before._replace(unknown_for=1)
    else:
        assert (after.mode, after.cause) == (Mode.ADOPT, Alarm("StaleOffset"))


def test_it_is_judged_once_in_off_and_at_a_sync() -> None:
    for mode in set(Mode) - {Mode.OFF}:
        assert started(held(500, 0, mode=mode)).mode is mode
    assert started(held(500, 0)._replace(adopt_checked=True)).mode is Mode.OFF
    assert started(held(500, 0), inputs=GOOD._replace(sync=False)) == held(500, 0)
    assert started(held(500, 0)).adopt_checked is True
    assert started(held(0, 0)) == held(0, 0)._replace(adopt_checked=True)


def test_doubt_lasts_six_readings_in_a_row_and_then_freezes_for_good() -> None:
    state = held(500, 0)
    for k in range(PATIENCE):
        assert (state.mode, state.unknown_for) == (Mode.OFF, k)
        state = started(state, "StaleData")
    unheard = state._replace(axes=held(None, 0).axes)
    assert started(unheard, "StaleData").unknown_for == 0
    state = started(state, "StaleData")
    assert (state.mode, state.adopt_checked) == (Mode.FROZEN, True)
    expected = "axis X: the offset that the drive reports cannot be trusted (152.6 um may still be applied: the drive's"
    assert state.cause is not None
    assert state.cause.sentence().startswith(expected)


def test_after_a_foreign_offset_the_drives_have_six_readings_to_agree() -> None:
    state = held(500, 0, mode=Mode.RAMP_DOWN)._replace(measuring=1)
    for k in range(1, PATIENCE):
        assert (state.mode, state.measuring) == (Mode.RAMP_DOWN, k)
        state = measure(state, GOOD, (Alarm("StaleData"),), MADE)
    assert (state.mode, state.measuring) == (Mode.RAMP_DOWN, PATIENCE)
    assert measure(state, GOOD, (Alarm("StaleData"),), MADE).mode is Mode.FROZEN
    known = measure(state, GOOD, (), MADE)
    assert [(axis.offset, axis.rate) for axis in known.axes] == [(500, 0), (0, 0)]
    assert known.measuring == 0


# --- what is doubted, and how it is told ---


@pytest.mark.parametrize(
    ("axis", "expected"),
    [
        ({"off_demand": 2.0}, ""),
        ({"off_demand": 2.5}, "152.6 um may still be applied: its demand (0x6062) contradicts it"),
        ({"off_demand": float("nan")}, "152.6 um may still be applied: its demand (0x6062) contradicts it"),
        ({"readings": 2}, "no three TPDOs in a row agree on it"),
        ({"read_back": None}, "no three TPDOs in a row agree on it"),
        ({"read_back": 819}, ""),
        ({"read_back": -820}, "-250.2 um may still be applied: beyond the ceiling of 250 um"),
    ],
)
def test_a_value_is_believed_that_was_shown_three_times_and_fits_ceiling_and_demand(
    axis: Mapping[str, Any], expected: str
) -> None:
    state = held(500, 0)
    state = state._replace(axes=(state.axes[0]._replace(**axis), state.axes[1]))
    assert doubts(views(state), ()) == ((Alarm("OffsetDoubtful", "X", expected),) if expected else ())


def test_a_value_is_believed_of_a_drive_that_is_as_it_was_commissioned() -> None:
    unknown = replace(MADE, axes=tuple([replace(axis, record="") for axis in MADE.axes]))
    longer = GOOD._replace(axes=(AxisInput(), AxisInput(long_frames=1)))
    assert doubts(views(held(500, 0)), (Alarm("NotCsp", "X"),)) == ()
    assert doubts(views(held(500, 0), unknown), ()) == (Alarm("NotCommissioned", "X"), Alarm("NotCommissioned", "Y"))
    assert doubts(views(held(500, 0), inputs=longer), ()) == (Alarm("PdoMapping", "Y"),)
    void = held(500, 0, record_void=True)
    assert doubts(views(void), ()) == (Alarm("RecordVoid", "X"), Alarm("RecordVoid", "Y"))


def test_who_is_told_of_a_doubt_is_told_the_axis_the_offset_and_the_reason() -> None:
    doubtful: Alarms = (Alarm("RecordVoid", "Y"),)
    reason = "axis Y: the drive has rebooted or its settings have changed since it was commissioned"
    for shown, axis, um in (((500, 0), "X", "152.6"), ((0, -500), "Y", "-152.6"), ((0, 0), "X", "0.0")):
        expected = Alarm("OffsetDoubtful", axis, f"{um} um may still be applied: {reason}")
        assert in_doubt(views(held(*shown)), doubtful) == expected
    own = Alarm("OffsetDoubtful", "X", "its own")
    assert in_doubt(views(held(None, 0)), (*doubtful, Alarm("OffsetDoubtful", "Y", "another's"), own)) == own


# --- what is taken over ---


def moving(**changes: Any) -> AxisState:
    made = AxisState(offset=600, rate=30, sent=(600, 570, 540, 510), read_back=540, readings=1, echo_misses=1)
    return made._replace(zero_shown=True, **changes)


def test_what_is_taken_over_is_at_rest_there_as_if_it_had_been_sent_for_ever() -> None:
    assert at_rest(moving(), 500) == AxisState(offset=500, sent=(500,) * 4, read_back=540, readings=1)
    assert at_zero(moving(read_back=0)) == AxisState(read_back=0, readings=3, zero_shown=True)


def test_what_is_to_be_read_anew_is_unknown() -> None:
    state = initial(MADE)._replace(axes=(moving(), moving()))
    assert unread(state).axes == (moving()._replace(read_back=None, zero_shown=False),) * 2


def test_adopting_begins_where_each_drive_is() -> None:
    before = held(500, 0, mode=Mode.FROZEN, offset=7, rate=3)._replace(zeros_sent=50, measuring=4)
    after = adopting(before, MADE)
    assert (after.mode, after.cause) == (Mode.ADOPT, Alarm("StaleOffset"))
    assert (after.zeros_sent, after.measuring) == (0, 0)
    assert after.axes == (at_rest(before.axes[0], 500), at_rest(before.axes[1], 0))


def test_where_nothing_is_held_adopting_is_off_with_all_at_zero() -> None:
    before = held(0, 0, mode=Mode.FROZEN, offset=600, rate=30, sent=(600,) * 6, echo_misses=2)
    after = adopting(before._replace(cause=Alarm("BusOff")), MADE)
    assert (after.mode, after.cause) == (Mode.OFF, None)
    assert after.axes == tuple(map(at_zero, before.axes))


@pytest.mark.parametrize(("fed", "set_up"), [(False, False), (False, True), (True, False), (True, True)])
def test_speed_and_torque_get_zeros_where_one_is_shown_and_there_is_an_rpdo(fed: bool, set_up: bool) -> None:
    made = fed_settings() if set_up else MADE
    after = adopting(held(500, 0, fed_back=(0, 40 if fed else 0)), made)
    assert after.mode is Mode.ADOPT
    zeroed = fed and set_up
    assert after.feed.mode is (FeedMode.ZEROING if zeroed else FeedMode.OFF)
    assert after.feed.cause == (Alarm("StaleOffset") if zeroed else None)
    assert after.feed.applied == (((0, 0), (0, 0)) if zeroed else ())


# --- what blocks ---


@pytest.mark.parametrize("measuring", [0, 7])
def test_what_was_shown_before_a_freeze_says_nothing_afterwards(measuring: int) -> None:
    before = held(500, 0, mode=Mode.ACTIVE, sent=(500,) * 6)._replace(places=(Place(9),), measuring=measuring)
    after = frozen(before, Alarm("BusOff"))
    assert (after.mode, after.cause, after.places, after.measuring) == (Mode.FROZEN, Alarm("BusOff"), (), 0)
    assert [axis.read_back for axis in after.axes] == [None, None]


def test_where_nothing_but_zeros_was_sent_and_shown_a_block_is_off() -> None:
    before = held(0, 0, mode=Mode.HOLD)._replace(places=(Place(9),))
    after = frozen(before, Alarm("BusOff"))
    assert (after.mode, after.cause, after.places) == (Mode.OFF, Alarm("BusOff"), ())
    assert frozen(before._replace(measuring=1), Alarm("BusOff")).mode is Mode.FROZEN


# --- what is refused, word for word ---


@pytest.mark.parametrize("mode", Mode)
def test_adopting_and_comparing_are_refused_while_it_sends(mode: Mode) -> None:
    state = held(500, 0, mode=mode)
    refused = (Alarm("NotOff", detail=mode.value),) if mode in SENDING else ()
    assert adopt_refusals(state, Request("adopt", True), (), views(state)) == refused
    assert compared(state, Request("compared", True), MADE) == (state, refused)
    assert (mode in AT_REST) is (not refused)


def test_a_drive_that_is_another_is_told_by_its_axis() -> None:
    expected = Alarm("RecordVoid", "Y", "it differs from the guard's record")
    for found, refused in (({"X": RECORD, "Y": "another"}, (expected,)), ({"X": RECORD}, ())):
        state, answer = compared(
            held(0, 0), Request("compared", True, compared=found, touched=dict.fromkeys("XY", 0)), MADE
        )
        assert answer == refused
        assert [axis.record_void for axis in state.axes] == [False, bool(refused)]
