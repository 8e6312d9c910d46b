"""For any demand, the sent set-points stay inside their bounds and can be stopped there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.commissioning.set_points import ROUNDING, AxisBounds, SetPointGenerator, plan_straight_move
from tests.drivers.frame_builder import build_machine_config

LOW, HIGH, SPEED, ACCELERATION = -40_000.0, 60_000.0, 1638.0, 13.1
X = AxisBounds("X", LOW, HIGH, SPEED, ACCELERATION, 16_384.0)
Y = AxisBounds("Y", -1e6, 1e6, 800.0, 5.0, 16_384.0)


def list_rows_until_rest(points: SetPointGenerator, most: int = 20_000) -> list[tuple[int, ...]]:
    rows = [points.advance_cycle()]
    while not points.is_resting and len(rows) < most:
        rows.append(points.advance_cycle())
    assert points.is_resting
    return rows


def require_bounds_kept(rows: Sequence[tuple[int, ...]], start: Sequence[int], bounds: Sequence[AxisBounds]) -> None:
    """The sent rows keep the bounds to whole increments."""
    column = np.array([start, start, *rows, rows[-1]], dtype=float)
    for place, of in enumerate(bounds):
        path = column[:, place]
        assert of.low - 1 <= path.min()
        assert path.max() <= of.high + 1
        assert np.abs(np.diff(path)).max() <= of.speed + ROUNDING + 1
        assert np.abs(np.diff(path, 2)).max() <= of.acceleration + ROUNDING + 2


def test_straight_move_is_played_to_its_end() -> None:
    points = SetPointGenerator((X, Y), (0, 100))
    rows = plan_straight_move((0, 100), (50_000, -20_000), (SPEED, 800), (ACCELERATION, 5.0), 30)
    points.play_rows(rows)
    out = list_rows_until_rest(points)
    assert points.stopped is None
    assert out[-1] == (50_000, -20_000)
    assert len(out) == len(rows) + 1  # and one cycle at rest
    require_bounds_kept(out, (0, 100), (X, Y))


def test_straight_move_uses_full_speed_and_acceleration() -> None:
    rows = plan_straight_move((0,), (50_000,), (400.0,), (10.0,))
    assert np.diff(rows[:, 0]).max() == pytest.approx(400.0)
    assert np.diff(rows[:, 0], 2).max() == pytest.approx(10.0, rel=1e-6)
    assert plan_straight_move((7,), (7,), (400.0,), (10.0,)).tolist() == [[7.0]]


@settings(max_examples=25)
@given(st.integers(0, 400))
def test_stop_brakes_immediately_and_straight_ahead(after: int) -> None:
    points = SetPointGenerator((X, Y), (0, 0))
    points.play_rows(plan_straight_move((0, 0), (50_000, 30_000), (SPEED, 800.0), (ACCELERATION, 5.0), 20))
    out = [points.advance_cycle() for _ in range(after)]
    points.brake_to_rest("Ctrl-C")
    out += list_rows_until_rest(points)
    assert points.stopped == "Ctrl-C"
    require_bounds_kept(out, (0, 0), (X, Y))
    assert len(out) - after <= math.ceil(max(SPEED / ACCELERATION, 800 / 5)) + 2
    assert all(abs(30_000 * x - 50_000 * y) <= 50_000 * 2 for x, y in out)  # it stays on the path
    points.play_rows([(0, 0)])
    assert points.advance_cycle() == out[-1]


@given(
    st.lists(st.tuples(st.floats(-70_000, 70_000) | st.just(math.nan), st.floats(-500, 500)), max_size=60),
    st.integers(-30_000, 30_000),
)
def test_sent_rows_keep_bounds_for_any_demand(asked: list[tuple[float, float]], start: int) -> None:
    points = SetPointGenerator((X, Y), (start, 0))
    points.play_rows(asked)
    require_bounds_kept(list_rows_until_rest(points), (start, 0), (X, Y))


@given(st.lists(st.floats(-ACCELERATION, ACCELERATION), min_size=1, max_size=600))
def test_demand_that_ends_in_motion_is_braked(pushes: list[float]) -> None:
    speeds = np.cumsum(pushes)
    points = SetPointGenerator((X,), (0,))
    points.play_rows([(at,) for at in np.cumsum(speeds)])
    require_bounds_kept(list_rows_until_rest(points), (0,), (X,))


def test_rows_leading_out_of_travel_are_braked_inside() -> None:
    points = SetPointGenerator((X,), (0,))
    points.play_rows(plan_straight_move((0,), (HIGH + 5000,), (SPEED,), (ACCELERATION,)))
    out = list_rows_until_rest(points)
    assert points.stopped == "axis X: it could not be braked inside its travel"
    require_bounds_kept(out, (0,), (X,))
    assert out[-1][0] > HIGH - 2 * SPEED


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ([(3000.0,)], "a set-point exceeds the axis' speed"),
        ([(40.0,)], "a set-point exceeds the axis' acceleration"),
        ([(math.inf,)], "is not a number"),
        ([(1.0, 2.0)], "is not a number"),
    ],
)
def test_invalid_row_is_never_sent(rows: list[tuple[float, ...]], why: str) -> None:
    points = SetPointGenerator((X,), (0,))
    points.play_rows(rows)
    assert list_rows_until_rest(points)[-1] == (0,)
    assert why in (points.stopped or "")


def test_axis_with_following_error_is_stopped() -> None:
    points = SetPointGenerator((X,), (0,))
    points.play_rows(plan_straight_move((0,), (50_000,), (SPEED,), (ACCELERATION,)))
    while points.stopped is None:
        points.advance_cycle((0,))
    assert points.stopped == "axis X: it does not follow its set-points"
    assert points.position[0] < 2 * X.following_error
    list_rows_until_rest(points)


def test_axes_hold_position_after_long_stall() -> None:
    points = SetPointGenerator((X,), (0,))
    points.play_rows(plan_straight_move((0,), (50_000,), (SPEED,), (ACCELERATION,)))
    out = [points.advance_cycle() for _ in range(100)]
    points.hold_last_row("late")
    assert list_rows_until_rest(points) == [out[-1]]
    assert points.stopped == "late"


def test_rows_after_stop_are_ignored() -> None:
    points = SetPointGenerator((X,), (7,))
    points.brake_to_rest("another master")
    assert points.advance_cycle() == (7,)
    points.play_rows(plan_straight_move((7,), (50_000,), (SPEED,), (ACCELERATION,)))
    assert points.is_resting
    assert list_rows_until_rest(points) == [(7,)]


def test_negative_sign_mirrors_travel() -> None:
    axis = build_machine_config(drive={"sign": -1}).axis["X"]
    bounds = AxisBounds.create_for_axis("X", axis, 0.001, (-10.0, 100.0), speed_mm_s=50.0)
    assert (bounds.low, bounds.high) == (-327_680.0, 32_768.0)
    assert bounds.speed == pytest.approx(0.05 * 3276.8)
    assert bounds.acceleration == pytest.approx(axis.max_acceleration_mm_s2 * 1e-6 * 3276.8)
    assert bounds.following_error == pytest.approx(5.0 * 3276.8)
