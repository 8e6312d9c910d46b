"""The feed-forward's law, limits, fades and gaps, cycle by cycle, without a machine."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.guard.feedforward import (
    Feed,
    FeedforwardLimits,
    Law,
    armed,
    end,
    hear,
    move,
    react,
    violates,
    zeroed,
    zeroing,
)
from fdhil.guard.interlocks import Alarm
from fdhil.guard.protocol import HOLD_CYCLES, FeedMode
from fdhil.guard.requests import parse_law
from fdhil.guard.transitions import ZEROS, ZEROS_UNCONFIRMED
from tests.guard.fed import LAW, LIMITS, ONE


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.booleans()), min_size=5, max_size=80), st.integers(1, 50)
)
def test_limits_hold_for_any_targets(expected: list[tuple[int, bool]], ending: int) -> None:
    feed: Feed = armed((LAW,))
    for k, (target, lost) in enumerate(expected):
        if k == ending:
            feed = end(feed, Alarm("Disarmed"))
        before = feed.applied
        feed = move(hear(feed, [None if lost else target]), [LIMITS], 20)
        assert not violates(LIMITS, before[0], feed.applied[0])
    feed = end(feed, Alarm("Disarmed"))
    for _ in range(60):
        feed = move(feed, [LIMITS], 20)
    assert feed.applied == ((0, 0),)
    assert feed.mode is FeedMode.OFF


def test_at_rest_the_law_says_zero() -> None:
    """Weights count from the newest target, so that their rounding leaves no offset at standstill."""
    assert LAW.offsets([123_456] * 3) == (0, 0)
    assert LAW.offsets([10, 0, -10]) == (2000, -20 + 20 + 30)
    assert LAW.offsets([-10, 0, 10]) == (-2000, 20 - 20 - 30)  # and dry friction acts in full, not more, either way


def test_a_law_looks_as_far_back_as_its_longest_weights() -> None:
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
def test_only_a_whole_law_is_taken(change: dict[str, object]) -> None:
    assert parse_law(GOOD) == Law((1,), (1,), (1,), 1)
    assert parse_law(GOOD | change) is None
    assert parse_law([GOOD]) is None


def fed(**changes: Any) -> Feed:
    return armed((LAW,))._replace(targets=((30, 20, 10),), **changes)


def test_it_fades_in_cycle_by_cycle_and_out_the_same_way() -> None:
    """Each of 10 cycles adds a tenth of the law's value, rounded down; fading out reverses it."""
    wide, feed = FeedforwardLimits(10**6, 10**6, 10**4, 10**4), fed()
    assert LAW.offsets((30, 20, 10)) == (2000, 30)
    seen = []
    for _ in range(12):
        feed = move(feed, [wide], 10)
        seen.append(feed.applied[0])
    assert seen == [(200 * k, 3 * k) for k in range(1, 11)] + [(2000, 30)] * 2
    feed = end(feed, Alarm("Disarmed"))
    seen = []
    for _ in range(10):
        feed = move(feed, [wide], 10)
        seen.append(feed.applied[0])
    assert seen == [(200 * k, 3 * k) for k in range(9, -1, -1)]
    assert feed.zeros == 1
    for _ in range(ZEROS - 1):
        feed = move(feed, [wide], 10)
        assert feed.mode is FeedMode.ENDING
    assert move(feed, [wide], 10).mode is FeedMode.OFF


def test_before_it_acts_zeros_are_in_force() -> None:
    none = ((0, 0), (0, 0))
    assert armed((LAW, LAW)).sent == (none,) * 4
    assert zeroing(2, Alarm("StaleOffset")) == Feed(FeedMode.ZEROING, sent=(none,), cause=Alarm("StaleOffset"))
    feed = armed((LAW, LAW))
    for k in range(9):
        feed = feed.send(((k, 0), (0, k)))
    assert feed.sent == tuple([((k, 0), (0, k)) for k in (8, 7, 6, 5)])


def test_what_did_not_leave_is_what_was_sent_before() -> None:
    first, second, third = ((1, 1),), ((2, 2),), ((3, 3),)
    assert Feed(sent=(third, second, first)).not_sent((0,)).sent == (second, second, first)
    assert Feed(sent=(third, second)).not_sent((0,)).sent == (second, second)
    assert Feed(sent=(third,)).not_sent((0,)).sent == (third,)
    assert Feed(sent=(third, second)).not_sent(()).sent == (third, second)


def test_an_axis_whose_offsets_left_holds_them() -> None:
    now, before = ((3, 1), (6, 2)), ((2, 1), (4, 2))
    assert Feed(sent=(now, before)).not_sent((1,)).sent == (((3, 1), (4, 2)), before)
    assert Feed(sent=(now, before)).not_sent((0,)).sent == (((2, 1), (6, 2)), before)


def test_zeros_end_it_after_more_than_three_that_are_shown_or_fifty_that_are_not() -> None:
    for confirmed, most in ((True, ZEROS), (False, ZEROS_UNCONFIRMED)):
        feed = zeroing(1, Alarm("StaleOffset"))
        for k in range(most):
            feed = move(feed, [LIMITS], 10, confirmed)
            assert (feed.mode, feed.zeros, feed.applied) == (FeedMode.ZEROING, k + 1, ((0, 0),))
        feed = zeroed(feed, confirmed)
        shown = Alarm("StaleOffset") if confirmed else Alarm("EchoMismatch", detail="no zero was read back")
        assert (feed.mode, feed.cause) == (FeedMode.OFF, shown)


def test_a_limit_that_takes_something_away_is_counted() -> None:
    assert LAW.offsets((30, 20, 10)) == (2000, 30)
    for speed, torque, counted in ((2000, 30, 0), (1999, 30, 1), (2000, 29, 1)):
        assert move(fed(), [FeedforwardLimits(speed, speed, torque, torque)], 10).limited == counted
    assert move(armed((LAW,)), [FeedforwardLimits(0, 0, 0, 0)], 10).limited == 0


def test_nothing_but_zeros_until_every_target_was_heard() -> None:
    feed = armed((LAW,))
    for received in (5, 1005):
        feed = move(hear(feed, [received]), [LIMITS], 10)
        assert (feed.applied, feed.share) == (((0, 0),), 0)
    feed = move(hear(feed, [2005]), [LIMITS], 10)
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
def test_the_check_of_a_frame_knows_the_limits_alone(after: Any, broken: bool) -> None:
    assert violates(LIMITS, (0, 0), after) is broken


def test_the_largest_values_are_the_last_that_pass() -> None:
    for largest, torque in ((40_000, 900), (-40_000, -900)):
        assert not violates(LIMITS, (largest, torque), (largest, torque))
        step = 1 if largest > 0 else -1
        assert violates(LIMITS, (largest, torque), (largest + step, torque))
        assert violates(LIMITS, (largest, torque), (largest, torque + step))
    assert not violates(LIMITS, (40_000, 900), (0, 0))  # zero may always be sent


def test_a_gap_is_bridged_for_ten_cycles_in_a_row() -> None:
    hold, feed = (Alarm("TargetLost"),), fed()
    for k in range(HOLD_CYCLES):
        feed = react(feed, hold)
        assert (feed.mode, feed.held) == (FeedMode.ON, k + 1)
    assert react(feed, hold).mode is FeedMode.ENDING
    assert react(feed, ()).held == 0
    assert react(react(feed, ()), hold).held == 1


def test_the_worst_alarm_decides() -> None:
    both = (Alarm("TargetLost"), Alarm("EchoMismatch"), Alarm("BusOff"))
    assert react(fed(), both[:2]).cause == Alarm("EchoMismatch")
    zeroing = react(fed(share=7, zeros=2), both)
    assert (zeroing.mode, zeroing.cause, zeroing.share, zeroing.zeros) == (FeedMode.ZEROING, Alarm("BusOff"), 0, 0)
    assert react(zeroing, (Alarm("SyncLost"),)).cause == Alarm("BusOff")
    assert react(fed(), (Alarm("StaleOffset"),)).mode is FeedMode.ON  # what only forbids arming
    assert react(Feed(), both).mode is FeedMode.OFF


def test_a_lost_target_goes_on_as_the_two_before_it() -> None:
    feed = armed((LAW,))
    assert hear(feed, [None]).targets == ((),)
    feed = hear(hear(feed, [100]), [None])
    assert feed.targets == ((100,),)
    feed = hear(hear(feed, [130]), [None])
    assert feed.targets == ((160, 130, 100),)
    assert hear(feed, [7]).targets == ((7, 160, 130),)


@given(st.integers(-(2**40), 2**40))
def test_dividing_by_the_scale_rounds_to_the_nearest(value: int) -> None:
    law = Law(speed=(value,), torque=(0,), pace=(0,), dry=0)
    assert abs(law.offsets((0, 1))[0] * ONE - value) <= ONE // 2
