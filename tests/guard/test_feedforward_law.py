"""The feed-forward's law, limits, fades and gaps, cycle by cycle, without a machine."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.guard.feedforward_law import (
    FeedforwardLimits,
    FeedforwardState,
    Law,
    advance_feedforward,
    advance_zeroing,
    arm_feedforward,
    begin_fade_out,
    begin_zeroing,
    react_to_alarms,
    take_targets,
    violates_limits,
)
from fdhil.guard.guard_protocol import HOLD_CYCLES, FeedMode
from fdhil.guard.interlocks import Alarm
from fdhil.guard.request_parsing import parse_law
from fdhil.guard.state_transitions import ZEROS, ZEROS_UNCONFIRMED
from tests.guard.feedforward_machine import LAW, LIMITS, ONE


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.booleans()), min_size=5, max_size=80), st.integers(1, 50)
)
def test_limits_hold_for_any_targets(expected: list[tuple[int, bool]], ending: int) -> None:
    feed: FeedforwardState = arm_feedforward((LAW,))
    for k, (target, lost) in enumerate(expected):
        if k == ending:
            feed = begin_fade_out(feed, Alarm("Disarmed"))
        before = feed.applied
        feed = advance_feedforward(take_targets(feed, [None if lost else target]), [LIMITS], 20)
        assert not violates_limits(LIMITS, before[0], feed.applied[0])
    feed = begin_fade_out(feed, Alarm("Disarmed"))
    for _ in range(60):
        feed = advance_feedforward(feed, [LIMITS], 20)
    assert feed.applied == ((0, 0),)
    assert feed.mode is FeedMode.OFF


def test_law_yields_zero_at_standstill() -> None:
    """Weights count from the newest target, so that their rounding leaves no offset at standstill."""
    assert LAW.compute_offsets([123_456] * 3) == (0, 0)
    assert LAW.compute_offsets([10, 0, -10]) == (2000, -20 + 20 + 30)
    assert LAW.compute_offsets([-10, 0, 10]) == (
        -2000,
        20 - 20 - 30,
    )  # and dry friction acts in full, not more, either way


def test_law_needs_as_many_targets_as_its_longest_weights() -> None:
    one, three = (1,), (1, 2, 3)
    for speed, torque, pace in ((three, one, one), (one, three, one), (one, one, three)):
        assert Law(speed, torque, pace, 0).depth == 4


GOOD = {"speed": [1], "torque": [1], "pace": [1], "dry": 1}


@pytest.mark.parametrize(
    "change",
    [
        {"speed": []},
        {"speed": [1.5]},
        {"pace": [True]},
        {"torque": [1] * 65},
        {"dry": 1 << 60},
        {"dry": None},
        {"pace": 3},
    ],
)
def test_incomplete_law_is_rejected(change: dict[str, object]) -> None:
    assert parse_law(GOOD) == Law((1,), (1,), (1,), 1)
    assert parse_law(GOOD | change) is None
    assert parse_law([GOOD]) is None


def fed(**changes: Any) -> FeedforwardState:
    return arm_feedforward((LAW,))._replace(targets=((30, 20, 10),), **changes)


def test_feedforward_fades_in_and_out_cycle_by_cycle() -> None:
    """Each of 10 cycles adds a tenth of the law's value, rounded down; fading out reverses it."""
    wide, feed = FeedforwardLimits(10**6, 10**6, 10**4, 10**4), fed()
    assert LAW.compute_offsets((30, 20, 10)) == (2000, 30)
    seen = []
    for _ in range(12):
        feed = advance_feedforward(feed, [wide], 10)
        seen.append(feed.applied[0])
    assert seen == [(200 * k, 3 * k) for k in range(1, 11)] + [(2000, 30)] * 2
    feed = begin_fade_out(feed, Alarm("Disarmed"))
    seen = []
    for _ in range(10):
        feed = advance_feedforward(feed, [wide], 10)
        seen.append(feed.applied[0])
    assert seen == [(200 * k, 3 * k) for k in range(9, -1, -1)]
    assert feed.zeros == 1
    for _ in range(ZEROS - 1):
        feed = advance_feedforward(feed, [wide], 10)
        assert feed.mode is FeedMode.ENDING
    assert advance_feedforward(feed, [wide], 10).mode is FeedMode.OFF


def test_zeros_are_in_force_before_the_feedforward_acts() -> None:
    none = ((0, 0), (0, 0))
    assert arm_feedforward((LAW, LAW)).sent == (none,) * 4
    assert begin_zeroing(2, Alarm("StaleOffset")) == FeedforwardState(
        FeedMode.ZEROING, sent=(none,), cause=Alarm("StaleOffset")
    )
    feed = arm_feedforward((LAW, LAW))
    for k in range(9):
        feed = feed.record_sent_pairs(((k, 0), (0, k)))
    assert feed.sent == tuple([((k, 0), (0, k)) for k in (8, 7, 6, 5)])


def test_unsent_frame_keeps_the_previous_pair() -> None:
    first, second, third = ((1, 1),), ((2, 2),), ((3, 3),)
    assert FeedforwardState(sent=(third, second, first)).restore_unsent_pairs((0,)).sent == (second, second, first)
    assert FeedforwardState(sent=(third, second)).restore_unsent_pairs((0,)).sent == (second, second)
    assert FeedforwardState(sent=(third,)).restore_unsent_pairs((0,)).sent == (third,)
    assert FeedforwardState(sent=(third, second)).restore_unsent_pairs(()).sent == (third, second)


def test_axis_whose_frame_left_keeps_its_pair() -> None:
    now, before = ((3, 1), (6, 2)), ((2, 1), (4, 2))
    assert FeedforwardState(sent=(now, before)).restore_unsent_pairs((1,)).sent == (((3, 1), (4, 2)), before)
    assert FeedforwardState(sent=(now, before)).restore_unsent_pairs((0,)).sent == (((2, 1), (6, 2)), before)


def test_feedforward_ends_after_three_shown_or_fifty_unconfirmed_zeros() -> None:
    for confirmed, most in ((True, ZEROS), (False, ZEROS_UNCONFIRMED)):
        feed = begin_zeroing(1, Alarm("StaleOffset"))
        for k in range(most):
            feed = advance_feedforward(feed, [LIMITS], 10, confirmed)
            assert (feed.mode, feed.zeros, feed.applied) == (FeedMode.ZEROING, k + 1, ((0, 0),))
        feed = advance_zeroing(feed, confirmed)
        shown = Alarm("StaleOffset") if confirmed else Alarm("EchoMismatch", detail="no zero was read back")
        assert (feed.mode, feed.cause) == (FeedMode.OFF, shown)


def test_limited_cycles_are_counted() -> None:
    assert LAW.compute_offsets((30, 20, 10)) == (2000, 30)
    for speed, torque, counted in ((2000, 30, 0), (1999, 30, 1), (2000, 29, 1)):
        assert advance_feedforward(fed(), [FeedforwardLimits(speed, speed, torque, torque)], 10).limited == counted
    assert advance_feedforward(arm_feedforward((LAW,)), [FeedforwardLimits(0, 0, 0, 0)], 10).limited == 0


def test_zeros_are_sent_until_enough_targets_were_received() -> None:
    feed = arm_feedforward((LAW,))
    for received in (5, 1005):
        feed = advance_feedforward(take_targets(feed, [received]), [LIMITS], 10)
        assert (feed.applied, feed.share) == (((0, 0),), 0)
    feed = advance_feedforward(take_targets(feed, [2005]), [LIMITS], 10)
    assert feed.share == 1
    assert any(feed.applied[0])


@pytest.mark.parametrize(
    ("after", "broken"),
    [
        ((40_000, 900), True),
        ((3_000, 120), False),
        ((3_001, 120), True),
        ((3_000, 121), True),
        ((-3_000, -120), False),
        ((-3_001, 0), True),
        ((0, -121), True),
        ((0, 0), False),
        ((0, 0.0), True),
        ((True, 0), True),
    ],
)
def test_frame_check_depends_on_the_limits_alone(after: Any, broken: bool) -> None:
    assert violates_limits(LIMITS, (0, 0), after) is broken


def test_frame_check_passes_the_largest_values() -> None:
    for largest, torque in ((40_000, 900), (-40_000, -900)):
        assert not violates_limits(LIMITS, (largest, torque), (largest, torque))
        step = 1 if largest > 0 else -1
        assert violates_limits(LIMITS, (largest, torque), (largest + step, torque))
        assert violates_limits(LIMITS, (largest, torque), (largest, torque + step))
    assert not violates_limits(LIMITS, (40_000, 900), (0, 0))  # zero may always be sent


def test_gap_is_bridged_for_ten_cycles() -> None:
    hold, feed = (Alarm("TargetLost"),), fed()
    for k in range(HOLD_CYCLES):
        feed = react_to_alarms(feed, hold)
        assert (feed.mode, feed.held) == (FeedMode.ON, k + 1)
    assert react_to_alarms(feed, hold).mode is FeedMode.ENDING
    assert react_to_alarms(feed, ()).held == 0
    assert react_to_alarms(react_to_alarms(feed, ()), hold).held == 1


def test_worst_alarm_decides_the_reaction() -> None:
    both = (Alarm("TargetLost"), Alarm("EchoMismatch"), Alarm("BusOff"))
    assert react_to_alarms(fed(), both[:2]).cause == Alarm("EchoMismatch")
    zeroing = react_to_alarms(fed(share=7, zeros=2), both)
    assert (zeroing.mode, zeroing.cause, zeroing.share, zeroing.zeros) == (FeedMode.ZEROING, Alarm("BusOff"), 0, 0)
    assert react_to_alarms(zeroing, (Alarm("SyncLost"),)).cause == Alarm("BusOff")
    assert react_to_alarms(fed(), (Alarm("StaleOffset"),)).mode is FeedMode.ON  # what only forbids arming
    assert react_to_alarms(FeedforwardState(), both).mode is FeedMode.OFF


def test_lost_target_is_extrapolated() -> None:
    feed = arm_feedforward((LAW,))
    assert take_targets(feed, [None]).targets == ((),)
    feed = take_targets(take_targets(feed, [100]), [None])
    assert feed.targets == ((100,),)
    feed = take_targets(take_targets(feed, [130]), [None])
    assert feed.targets == ((160, 130, 100),)
    assert take_targets(feed, [7]).targets == ((7, 160, 130),)


@given(st.integers(-(2**40), 2**40))
def test_fixed_point_division_rounds_to_nearest(value: int) -> None:
    law = Law(speed=(value,), torque=(0,), pace=(0,), dry=0)
    assert abs(law.compute_offsets((0, 1))[0] * ONE - value) <= ONE // 2
