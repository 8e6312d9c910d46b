"""Rules for trusting and adopting a drive's offset, each by itself, without a machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from fdhil.guard.corrected_path import PathPosition
from fdhil.guard.guard_protocol import AT_REST, SENDING, FeedMode, Mode
from fdhil.guard.guard_settings import GuardSettings
from fdhil.guard.guard_state import (
    AxisInput,
    AxisState,
    BusView,
    GuardRequest,
    GuardState,
    StepInputs,
    make_initial_state,
)
from fdhil.guard.interlock_checks import Views, combine_axis_views
from fdhil.guard.interlocks import INTERLOCK_CATALOGUE, Alarm, Alarms, Reaction
from fdhil.guard.offset_adoption import (
    adopt_at_start,
    apply_drive_comparison,
    begin_adoption,
    choose_freeze_cause,
    discard_read_backs,
    find_adoption_doubts,
    freeze_sending,
    list_adopt_refusals,
    set_offset_at_rest,
    set_offset_confirmed_zero,
    wait_for_read_backs,
)
from tests.guard import simulated_bus
from tests.guard.feedforward_machine import fed_settings
from tests.guard.simulated_bus import RECORD

MADE = simulated_bus.settings()
GOOD = StepInputs(True, (AxisInput(), AxisInput()), BusView())
PATIENCE = 60
"""SYNC: six of the TPDOs that show the offset, one every ten SYNC."""
WAITS = {code for code, row in INTERLOCK_CATALOGUE.items() if row[0] is Reaction.FREEZE} | {
    *("SyncJitter", "OffsetHijack", "BusLocked")
}
DOUBTS = {"StaleData", "TargetLost", "FollowingError", "Implausible", "PdoLength"}


def held(*shown: int | None, mode: Mode = Mode.OFF, **changes: Any) -> GuardState:
    state = make_initial_state(MADE)
    axes = [a._replace(read_back=s, readings=3, **changes) for a, s in zip(state.axes, shown, strict=True)]
    return state._replace(mode=mode, axes=tuple(axes))


def views(state: GuardState, made: GuardSettings = MADE, inputs: StepInputs = GOOD) -> Views:
    return combine_axis_views(made, inputs, state)


def started(state: GuardState, *alarms: str, inputs: StepInputs = GOOD) -> GuardState:
    return adopt_at_start(state, inputs, tuple(map(Alarm, alarms)), views(state, inputs=inputs), MADE)


# --- at the start ---


@pytest.mark.parametrize("code", INTERLOCK_CATALOGUE)
def test_adoption_at_start_needs_an_undisturbed_bus_and_plausible_values(code: str) -> None:
    before = held(500, 0)
    after = started(before, code)
    if code in WAITS:
        assert after == before
    elif code in DOUBTS:
        assert after == before._replace(unknown_for=1)
    else:
        assert (after.mode, after.cause) == (Mode.ADOPT, Alarm("StaleOffset"))


def test_adoption_at_start_is_decided_once_in_off_at_a_sync() -> None:
    for mode in set(Mode) - {Mode.OFF}:
        assert started(held(500, 0, mode=mode)).mode is mode
    assert started(held(500, 0)._replace(adopt_checked=True)).mode is Mode.OFF
    assert started(held(500, 0), inputs=GOOD._replace(sync=False)) == held(500, 0)
    assert started(held(500, 0)).adopt_checked is True
    assert started(held(0, 0)) == held(0, 0)._replace(adopt_checked=True)


def test_six_doubtful_readings_in_a_row_freeze() -> None:
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


def test_drives_have_six_readings_to_agree_after_a_foreign_offset() -> None:
    state = held(500, 0, mode=Mode.RAMP_DOWN)._replace(measuring=1)
    for k in range(1, PATIENCE):
        assert (state.mode, state.measuring) == (Mode.RAMP_DOWN, k)
        state = wait_for_read_backs(state, GOOD, (Alarm("StaleData"),), MADE)
    assert (state.mode, state.measuring) == (Mode.RAMP_DOWN, PATIENCE)
    assert wait_for_read_backs(state, GOOD, (Alarm("StaleData"),), MADE).mode is Mode.FROZEN
    known = wait_for_read_backs(state, GOOD, (), MADE)
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
def test_value_is_trusted_after_three_readings_within_ceiling_and_demand(
    axis: Mapping[str, Any], expected: str
) -> None:
    state = held(500, 0)
    state = state._replace(axes=(state.axes[0]._replace(**axis), state.axes[1]))
    assert find_adoption_doubts(views(state), ()) == ((Alarm("OffsetDoubtful", "X", expected),) if expected else ())


def test_value_is_trusted_only_from_a_drive_as_commissioned() -> None:
    unknown = replace(MADE, axes=tuple([replace(axis, record="") for axis in MADE.axes]))
    longer = GOOD._replace(axes=(AxisInput(), AxisInput(long_frames=1)))
    assert find_adoption_doubts(views(held(500, 0)), (Alarm("NotCsp", "X"),)) == ()
    assert find_adoption_doubts(views(held(500, 0), unknown), ()) == (
        Alarm("NotCommissioned", "X"),
        Alarm("NotCommissioned", "Y"),
    )
    assert find_adoption_doubts(views(held(500, 0), inputs=longer), ()) == (Alarm("PdoMapping", "Y"),)
    void = held(500, 0, record_void=True)
    assert find_adoption_doubts(views(void), ()) == (Alarm("RecordVoid", "X"), Alarm("RecordVoid", "Y"))


def test_doubt_is_reported_with_axis_offset_and_reason() -> None:
    doubtful: Alarms = (Alarm("RecordVoid", "Y"),)
    reason = "axis Y: the drive has rebooted or its settings have changed since it was commissioned"
    for shown, axis, um in (((500, 0), "X", "152.6"), ((0, -500), "Y", "-152.6"), ((0, 0), "X", "0.0")):
        expected = Alarm("OffsetDoubtful", axis, f"{um} um may still be applied: {reason}")
        assert choose_freeze_cause(views(held(*shown)), doubtful) == expected
    own = Alarm("OffsetDoubtful", "X", "its own")
    assert choose_freeze_cause(views(held(None, 0)), (*doubtful, Alarm("OffsetDoubtful", "Y", "another's"), own)) == own


# --- what is taken over ---


def moving(**changes: Any) -> AxisState:
    made = AxisState(offset=600, rate=30, sent=(600, 570, 540, 510), read_back=540, readings=1, echo_misses=1)
    return made._replace(zero_shown=True, **changes)


def test_adopted_offset_stands_as_if_it_had_always_been_sent() -> None:
    assert set_offset_at_rest(moving(), 500) == AxisState(offset=500, sent=(500,) * 4, read_back=540, readings=1)
    assert set_offset_confirmed_zero(moving(read_back=0)) == AxisState(read_back=0, readings=3, zero_shown=True)


def test_discarded_read_back_is_unknown() -> None:
    state = make_initial_state(MADE)._replace(axes=(moving(), moving()))
    assert discard_read_backs(state).axes == (moving()._replace(read_back=None, zero_shown=False),) * 2


def test_adoption_starts_from_the_read_back_of_each_drive() -> None:
    before = held(500, 0, mode=Mode.FROZEN, offset=7, rate=3)._replace(zeros_sent=50, measuring=4)
    after = begin_adoption(before, MADE)
    assert (after.mode, after.cause) == (Mode.ADOPT, Alarm("StaleOffset"))
    assert (after.zeros_sent, after.measuring) == (0, 0)
    assert after.axes == (set_offset_at_rest(before.axes[0], 500), set_offset_at_rest(before.axes[1], 0))


def test_adoption_goes_off_when_all_drives_hold_zero() -> None:
    before = held(0, 0, mode=Mode.FROZEN, offset=600, rate=30, sent=(600,) * 6, echo_misses=2)
    after = begin_adoption(before._replace(cause=Alarm("BusOff")), MADE)
    assert (after.mode, after.cause) == (Mode.OFF, None)
    assert after.axes == tuple(map(set_offset_confirmed_zero, before.axes))


@pytest.mark.parametrize(("fed", "set_up"), [(False, False), (False, True), (True, False), (True, True)])
def test_adoption_zeroes_a_shown_speed_or_torque_offset_if_an_rpdo_exists(fed: bool, set_up: bool) -> None:
    made = fed_settings() if set_up else MADE
    after = begin_adoption(held(500, 0, fed_back=(0, 40 if fed else 0)), made)
    assert after.mode is Mode.ADOPT
    zeroed = fed and set_up
    assert after.feed.mode is (FeedMode.ZEROING if zeroed else FeedMode.OFF)
    assert after.feed.cause == (Alarm("StaleOffset") if zeroed else None)
    assert after.feed.applied == (((0, 0), (0, 0)) if zeroed else ())


# --- what blocks ---


@pytest.mark.parametrize("measuring", [0, 7])
def test_read_back_before_a_freeze_is_discarded(measuring: int) -> None:
    before = held(500, 0, mode=Mode.ACTIVE, sent=(500,) * 6)._replace(places=(PathPosition(9),), measuring=measuring)
    after = freeze_sending(before, Alarm("BusOff"))
    assert (after.mode, after.cause, after.places, after.measuring) == (Mode.FROZEN, Alarm("BusOff"), (), 0)
    assert [axis.read_back for axis in after.axes] == [None, None]


def test_blocking_alarm_goes_off_when_only_zeros_were_sent_and_shown() -> None:
    before = held(0, 0, mode=Mode.HOLD)._replace(places=(PathPosition(9),))
    after = freeze_sending(before, Alarm("BusOff"))
    assert (after.mode, after.cause, after.places) == (Mode.OFF, Alarm("BusOff"), ())
    assert freeze_sending(before._replace(measuring=1), Alarm("BusOff")).mode is Mode.FROZEN


# --- what is refused, word for word ---


@pytest.mark.parametrize("mode", Mode)
def test_adopt_and_comparison_are_refused_while_sending(mode: Mode) -> None:
    state = held(500, 0, mode=mode)
    refused = (Alarm("NotOff", detail=mode.value),) if mode in SENDING else ()
    assert list_adopt_refusals(state, GuardRequest("adopt", True), (), views(state)) == refused
    assert apply_drive_comparison(state, GuardRequest("compared", True), MADE) == (state, refused)
    assert (mode in AT_REST) is (not refused)


def test_drive_that_differs_from_its_record_is_reported_with_its_axis() -> None:
    expected = Alarm("RecordVoid", "Y", "it differs from the guard's record")
    for found, refused in (({"X": RECORD, "Y": "another"}, (expected,)), ({"X": RECORD}, ())):
        state, answer = apply_drive_comparison(
            held(0, 0), GuardRequest("compared", True, compared=found, touched=dict.fromkeys("XY", 0)), MADE
        )
        assert answer == refused
        assert [axis.record_void for axis in state.axes] == [False, bool(refused)]
