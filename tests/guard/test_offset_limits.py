"""Limits and motion of offsets: enumerated where small, sampled where large."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fdhil.guard.correction_table import check_rows
from fdhil.guard.offset_limits import (
    OffsetLimits,
    OffsetTravel,
    compute_approach_rate,
    compute_limit_ceilings,
    compute_offset_ceiling,
    compute_stopping_distance,
    decelerate_offset,
    find_limit_violation,
    move_toward_goal,
)
from tests.guard.simulated_bus import ramp_cycles

SMALL = OffsetLimits(offset=40, rate=9, acceleration=2, variation=400, window=100)


def braking_way(rate: int, acceleration: int) -> int:
    way = 0
    while rate > acceleration:
        rate -= acceleration
        way += rate
    return way


@pytest.mark.usefixtures("real_time")
@given(st.integers(0, 500), st.integers(1, 60))
def test_stopping_distance_is_the_sum_of_the_braking_steps(rate: int, acceleration: int) -> None:
    assert compute_stopping_distance(rate, acceleration) == braking_way(rate, acceleration)
    assert type(compute_stopping_distance(rate, acceleration)) is int


@pytest.mark.usefixtures("real_time")
@given(st.integers(0, 5000), st.integers(1, 60))
def test_approach_rate_is_the_fastest_that_still_stops(distance: int, acceleration: int) -> None:
    rate = compute_approach_rate(distance, acceleration)
    assert rate + compute_stopping_distance(rate, acceleration) <= distance
    assert rate + 1 + compute_stopping_distance(rate + 1, acceleration) > distance
    assert type(rate) is int


def starts(limits: OffsetLimits) -> list[tuple[int, int]]:
    return [
        (offset, rate)
        for offset in range(-limits.offset, limits.offset + 1)
        for rate in range(-limits.hard_rate, limits.hard_rate + 1)
        if abs(offset - rate) <= limits.offset and find_limit_violation(limits, offset - rate, rate, offset) is None
    ]


@pytest.mark.parametrize(
    "limits",
    [
        SMALL,
        OffsetLimits(30, 1, 1, 400, 100),
        OffsetLimits(25, 7, 1, 400, 100),
        OffsetLimits(60, 20, 20, 400, 100),
        OffsetLimits(164, 6, 1, 9830, 1000),
    ],
)
def test_ramp_to_zero_from_every_start_keeps_limits_and_duration(limits: OffsetLimits) -> None:
    for start in starts(limits):
        offset, rate = start
        for _ in range(ramp_cycles(limits, offset)):
            after = move_toward_goal(limits, offset, rate, 0, 0)
            assert find_limit_violation(limits, offset, rate, after) is None, (start, offset, rate, after)
            offset, rate = after, after - offset
        assert (offset, rate) == (0, 0), start


@pytest.mark.parametrize("limits", [SMALL, OffsetLimits(25, 7, 1, 400, 100)])
def test_outward_motion_ends_within_the_braking_time(limits: OffsetLimits) -> None:
    rising = -(-limits.hard_rate // limits.acceleration)
    for start in starts(limits):
        offset, rate = start
        for cycle in range(ramp_cycles(limits, offset)):
            after = move_toward_goal(limits, offset, rate, 0, 0)
            crossed = start[0] * start[1] < 0  # one that runs through zero turns once behind it
            assert crossed or cycle < rising or abs(after) <= abs(offset), (start, cycle)
            offset, rate = after, after - offset


def test_braking_stops_within_the_limits() -> None:
    for start in starts(SMALL):
        offset, rate = start
        for _ in range(-(-SMALL.hard_rate // SMALL.acceleration) + 1):
            after = decelerate_offset(SMALL, offset, rate)
            assert find_limit_violation(SMALL, offset, rate, after) is None, start
            offset, rate = after, after - offset
        assert rate == 0, start


@pytest.mark.usefixtures("real_time")
@given(st.lists(st.integers(-60, 60), min_size=1, max_size=60), st.data())
def test_following_any_goal_keeps_every_limit(goals: list[int], data: st.DataObject) -> None:
    offset, rate = data.draw(st.sampled_from(starts(SMALL)))
    before = 0
    for goal in goals:
        after = move_toward_goal(SMALL, offset, rate, goal, goal - before)
        assert find_limit_violation(SMALL, offset, rate, after) is None
        offset, rate, before = after, after - offset, goal


@given(st.integers(-30, 30), st.integers(-3, 3))
def test_moving_goal_is_reached_and_followed_exactly(start: int, speed: int) -> None:
    offset, rate, goal = start, 0, -speed * 4
    for _ in range(60):
        goal += speed if abs(goal + speed) < 20 else 0
        moving = speed if abs(goal + speed) < 20 else 0
        offset, rate = (after := move_toward_goal(SMALL, offset, rate, goal, moving)), after - offset
    assert offset == goal


def test_adopted_offset_beyond_the_limit_only_shrinks() -> None:
    offset, rate = 500, 0
    for _ in range(200):
        after = move_toward_goal(SMALL, offset, rate, 0, 0)
        assert find_limit_violation(SMALL, offset, rate, after) is None
        assert after <= offset
        offset, rate = after, after - offset
    assert offset == 0


@pytest.mark.parametrize(
    ("before", "rate", "offset", "expected"),
    [
        (40, 0, 41, "OffsetLimit"),
        (40, 0, 40, None),
        (0, 9, 10, None),
        (0, 9, 11, "OffsetRate"),
        (0, 0, 4, None),
        (0, 0, 5, "OffsetRate"),
        (0, -1, 4, "OffsetRate"),
        (30, 6, 38, "OffsetLimit"),  # it could not stop before 40 any more
        (38, -6, 30, None),
        (-30, -6, -38, "OffsetLimit"),
    ],
)
def test_each_limit_passes_at_its_edge(before: int, rate: int, offset: int, expected: str | None) -> None:
    assert find_limit_violation(SMALL, before, rate, offset) == expected


def test_rows_are_checked_at_every_position() -> None:
    rows = [0] * 50
    assert check_rows(SMALL, rows, 0, 50) is None
    for k in range(1, 50):
        broken = list(rows)
        broken[k] = 5
        assert check_rows(SMALL, broken, 0, 50) == "OffsetRate"
        assert check_rows(SMALL, broken, 0, k) is None
        assert check_rows(SMALL, broken, k, 50) == "OffsetRate"
    assert check_rows(SMALL, [41, *rows], 0, 51) == "OffsetLimit"


def test_total_variation_covers_any_second() -> None:
    swing = [(k % 4 > 1) * 2 for k in range(400)]  # 1 increment per cycle on average
    quiet = OffsetLimits(40, 9, 2, 100, 100)
    assert check_rows(quiet, swing, 0, 400) is None
    assert check_rows(OffsetLimits(40, 9, 2, 97, 100), swing, 0, 400) == "OffsetEnergy"
    pieces = [check_rows(OffsetLimits(40, 9, 2, 97, 100), swing, k, k + 10) for k in range(0, 400, 10)]
    assert pieces[5] is None
    assert set(pieces[11:]) == {"OffsetEnergy"}


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("window", [10, 20, 100])
@example([9] * 350)
@example([k % 19 - 9 for k in range(350)])
@given(st.lists(st.integers(-9, 9), min_size=1, max_size=350))
def test_travel_covers_nine_tenths_to_one_second(window: int, moves: list[int]) -> None:
    travel = OffsetTravel()
    for k, move in enumerate(moves):
        travel = travel.add_move(move, window)
        assert sum(map(abs, moves[max(0, k + 1 - window * 9 // 10) : k + 1])) <= travel.total
        assert travel.total <= sum(map(abs, moves[max(0, k + 1 - window) : k + 1]))


def test_standstill_and_inward_motion_are_allowed_outside_the_limit() -> None:
    assert find_limit_violation(SMALL, SMALL.offset + 5, 0, SMALL.offset + 5) is None
    assert find_limit_violation(SMALL, SMALL.offset + 5, 0, SMALL.offset + 4) is None
    assert find_limit_violation(SMALL, -SMALL.offset - 5, 0, -SMALL.offset - 5) is None
    assert find_limit_violation(SMALL, SMALL.offset + 5, 0, SMALL.offset + 6) == "OffsetLimit"
    assert find_limit_violation(SMALL, -SMALL.offset - 5, 0, -SMALL.offset - 6) == "OffsetLimit"


def test_table_is_followed_up_to_rounding_and_approached_within_the_limit() -> None:
    assert (
        move_toward_goal(SMALL, 0, 3, 3 + SMALL.hard_acceleration, 3 + SMALL.hard_acceleration)
        == 3 + SMALL.hard_acceleration
    )
    assert move_toward_goal(SMALL, 0, 3, 20, 3 + SMALL.hard_acceleration) == 3 + SMALL.acceleration
    assert move_toward_goal(SMALL, 0, -3, 4, 4) == -3 + SMALL.acceleration  # met, but by more than rounding explains


@pytest.mark.parametrize(
    ("increments_per_mm", "rate"), [(24.9, 0), (25.0, 1), (60.0, 1), (100.0, 2), (149.9, 2), (150.0, 3)]
)
def test_coarse_drive_may_move_one_increment_up_to_twice_the_ceiling(increments_per_mm: float, rate: int) -> None:
    """20 mm/s at 1 ms: 25 increments per mm are half an increment per cycle, 100 are exactly two."""
    assert compute_limit_ceilings(increments_per_mm, 0.001, 500.0, 4000.0).rate == rate


def test_integer_ceiling_is_reached() -> None:
    assert compute_offset_ceiling(4.0) == 1
    assert compute_offset_ceiling(1000.0) == 250
    assert compute_limit_ceilings(1000.0, 0.001, 500.0, 4000.0).variation == 3000
