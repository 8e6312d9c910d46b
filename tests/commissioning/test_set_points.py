"""For any demand, the sent set-points stay inside their bounds and can be stopped there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.commissioning.set_points import ROUNDING, Bounds, SetPoints, straight
from tests.drivers.frame_builder import build_machine_config

LOW, HIGH, SPEED, ACCELERATION = -40_000.0, 60_000.0, 1638.0, 13.1
X = Bounds("X", LOW, HIGH, SPEED, ACCELERATION, 16_384.0)
Y = Bounds("Y", -1e6, 1e6, 800.0, 5.0, 16_384.0)


def sent(points: SetPoints, most: int = 20_000) -> list[tuple[int, ...]]:
    rows = [points.step()]
    while not points.resting and len(rows) < most:
        rows.append(points.step())
    assert points.resting
    return rows


def inside(rows: Sequence[tuple[int, ...]], start: Sequence[int], bounds: Sequence[Bounds]) -> None:
    """The sent rows keep the bounds to whole increments."""
    column = np.array([start, start, *rows, rows[-1]], dtype=float)
    for place, of in enumerate(bounds):
        path = column[:, place]
        assert of.low - 1 <= path.min()
        assert path.max() <= of.high + 1
        assert np.abs(np.diff(path)).max() <= of.speed + ROUNDING + 1
        assert np.abs(np.diff(path, 2)).max() <= of.acceleration + ROUNDING + 2


def test_a_way_there_is_played_to_its_end() -> None:
    points = SetPoints((X, Y), (0, 100))
    rows = straight((0, 100), (50_000, -20_000), (SPEED, 800), (ACCELERATION, 5.0), 30)
    points.play(rows)
    out = sent(points)
    assert points.stopped is None
    assert out[-1] == (50_000, -20_000)
    assert len(out) == len(rows) + 1  # and one cycle at rest
    inside(out, (0, 100), (X, Y))


def test_a_straight_way_uses_what_it_may() -> None:
    rows = straight((0,), (50_000,), (400.0,), (10.0,))
    assert np.diff(rows[:, 0]).max() == pytest.approx(400.0)
    assert np.diff(rows[:, 0], 2).max() == pytest.approx(10.0, rel=1e-6)
    assert straight((7,), (7,), (400.0,), (10.0,)).tolist() == [[7.0]]


@settings(max_examples=25)
@given(st.integers(0, 400))
def test_a_stop_brakes_at_once_and_straight_ahead(after: int) -> None:
    points = SetPoints((X, Y), (0, 0))
    points.play(straight((0, 0), (50_000, 30_000), (SPEED, 800.0), (ACCELERATION, 5.0), 20))
    out = [points.step() for _ in range(after)]
    points.stop("Ctrl-C")
    out += sent(points)
    assert points.stopped == "Ctrl-C"
    inside(out, (0, 0), (X, Y))
    assert len(out) - after <= math.ceil(max(SPEED / ACCELERATION, 800 / 5)) + 2
    assert all(abs(30_000 * x - 50_000 * y) <= 50_000 * 2 for x, y in out)  # it stays on the path
    points.play([(0, 0)])
    assert points.step() == out[-1]


@given(
    st.lists(st.tuples(st.floats(-70_000, 70_000) | st.just(math.nan), st.floats(-500, 500)), max_size=60),
    st.integers(-30_000, 30_000),
)
def test_what_leaves_keeps_its_bounds_whatever_is_asked_for(asked: list[tuple[float, float]], start: int) -> None:
    points = SetPoints((X, Y), (start, 0))
    points.play(asked)
    inside(sent(points), (start, 0), (X, Y))


@given(st.lists(st.floats(-ACCELERATION, ACCELERATION), min_size=1, max_size=600))
def test_a_wild_ride_that_ends_in_motion_is_braked(pushes: list[float]) -> None:
    speeds = np.cumsum(pushes)
    points = SetPoints((X,), (0,))
    points.play([(at,) for at in np.cumsum(speeds)])
    inside(sent(points), (0,), (X,))


def test_rows_that_lead_out_of_the_travel_are_braked_inside_it() -> None:
    points = SetPoints((X,), (0,))
    points.play(straight((0,), (HIGH + 5000,), (SPEED,), (ACCELERATION,)))
    out = sent(points)
    assert points.stopped == "axis X: it could not be braked inside its travel"
    inside(out, (0,), (X,))
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
def test_a_wrong_row_never_leaves(rows: list[tuple[float, ...]], why: str) -> None:
    points = SetPoints((X,), (0,))
    points.play(rows)
    assert sent(points)[-1] == (0,)
    assert why in (points.stopped or "")


def test_an_axis_that_does_not_follow_is_stopped() -> None:
    points = SetPoints((X,), (0,))
    points.play(straight((0,), (50_000,), (SPEED,), (ACCELERATION,)))
    while points.stopped is None:
        points.step((0,))
    assert points.stopped == "axis X: it does not follow its set-points"
    assert points.position[0] < 2 * X.following_error
    sent(points)


def test_after_a_long_stall_the_axes_stay_where_the_drives_stand() -> None:
    points = SetPoints((X,), (0,))
    points.play(straight((0,), (50_000,), (SPEED,), (ACCELERATION,)))
    out = [points.step() for _ in range(100)]
    points.hold("late")
    assert sent(points) == [out[-1]]
    assert points.stopped == "late"


def test_rows_that_come_after_a_stop_are_ignored_and_the_axes_rest() -> None:
    points = SetPoints((X,), (7,))
    points.stop("another master")
    assert points.step() == (7,)
    points.play(straight((7,), (50_000,), (SPEED,), (ACCELERATION,)))
    assert points.resting
    assert sent(points) == [(7,)]


def test_a_drive_that_counts_against_the_axis_has_its_travel_turned() -> None:
    axis = build_machine_config(drive={"sign": -1}).axis["X"]
    bounds = Bounds.of("X", axis, 0.001, (-10.0, 100.0), speed_mm_s=50.0)
    assert (bounds.low, bounds.high) == (-327_680.0, 32_768.0)
    assert bounds.speed == pytest.approx(0.05 * 3276.8)
    assert bounds.acceleration == pytest.approx(axis.max_acceleration_mm_s2 * 1e-6 * 3276.8)
    assert bounds.following_error == pytest.approx(5.0 * 3276.8)
