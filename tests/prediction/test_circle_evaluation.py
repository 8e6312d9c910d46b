"""The circular test of ISO 230-4: G, H and F of circles with known errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fdhil.errors import RecordingError
from fdhil.prediction.circle_evaluation import evaluate_circle, write_circle_program
from fdhil.program import load_trajectory
from fdhil.records import Float
from tests.bench import bench_config

RADIUS = 50.0


Error = Callable[[Float], Float]


def make_run(error_um: float) -> Error:
    return lambda at: np.full(at.shape, error_um)


def join_runs(counter_um: Error, clockwise_um: Error, turns: float = 1.3, points: int = 9000) -> Float:
    angle = np.linspace(0.0, turns * 2 * np.pi, points)
    way = [np.column_stack([np.linspace(0.0, RADIUS, 200), np.zeros(200)])]
    for at, error_um in ((angle, counter_um), (angle[::-1], clockwise_um)):
        radius = RADIUS + 1e-3 * error_um(at)
        way.append(radius[:, None] * np.column_stack([np.cos(at), np.sin(at)]))
    return np.concatenate(way)


def test_true_circle_has_no_deviation() -> None:
    found = evaluate_circle(join_runs(make_run(0.0), make_run(0.0)), RADIUS, (0.0, 0.0))
    assert found.both_um < 0.01
    assert found.hysteresis_um < 0.01


def test_radius_difference_between_runs_is_hysteresis() -> None:
    found = evaluate_circle(join_runs(make_run(4.0), make_run(-2.0)), RADIUS, (0.0, 0.0))
    assert found.hysteresis_um == pytest.approx(6.0, abs=0.01)
    assert found.both_um == pytest.approx(6.0, abs=0.01)
    assert max(found.deviations_um) < 0.01
    assert found.radial_um == pytest.approx((4.0, -2.0), abs=0.01)


def test_ellipse_deviation_equals_axis_difference() -> None:
    found = evaluate_circle(
        join_runs(lambda at: 5.0 * np.cos(2 * at), lambda at: 5.0 * np.cos(2 * at)), RADIUS, (0.0, 0.0)
    )
    assert found.deviations_um == pytest.approx((10.0, 10.0), abs=0.02)
    assert found.hysteresis_um < 0.02
    assert found.counter_um[0] == pytest.approx(5.0, abs=0.02)


def test_centre_position_has_no_effect() -> None:
    """A ball bar does not measure the programmed centre: an offset of 20 um is no deviation."""
    moved = join_runs(make_run(3.0), make_run(3.0)) + np.array([120.02, -79.98])
    for centre in ((120.0, -80.0), None):
        found = evaluate_circle(moved, RADIUS, centre)
        assert found.both_um < 0.05
        assert found.radial_um[0] == pytest.approx(3.0, abs=0.05)


def test_start_and_stop_are_excluded() -> None:
    """The middle 360 degrees of a longer run are evaluated."""
    path = join_runs(make_run(0.0), make_run(0.0), turns=1.5)
    path[200:1200] *= 1.001  # 50 um at the start of the first run
    assert evaluate_circle(path, RADIUS, (0.0, 0.0)).both_um < 0.01


@pytest.mark.parametrize("turns", [0.4, 0.9])
def test_partial_circle_is_refused(turns: float) -> None:
    with pytest.raises(RecordingError, match="360 degrees in both directions"):
        evaluate_circle(join_runs(make_run(0.0), make_run(0.0), turns=turns), RADIUS, (0.0, 0.0))


def test_wrong_radius_is_refused() -> None:
    with pytest.raises(RecordingError, match="check the radius"):
        evaluate_circle(join_runs(make_run(0.0), make_run(0.0)), 20.0)


def test_program_contains_requested_values() -> None:
    """G code has no exponents, and a circle of 50.12345 mm is not one of 50.1234 mm."""
    program = write_circle_program(("X", "Y"), 50.123456, 1_000_000.0)
    assert "G3 X50.123456 Y0 I-50.123456 J0 P2 F1000000.000000" in program
    assert "e" not in write_circle_program(("X", "Y"), 0.1, 0.00001)


@pytest.mark.parametrize("plane", [("X", "Y"), ("X", "Z"), ("Y", "Z")])
def test_program_starts_counter_clockwise(plane: tuple[str, str], tmp_path: Path) -> None:
    program = tmp_path / "circle.ngc"
    program.write_text(write_circle_program(plane, 10.0, 3000.0))
    reference = load_trajectory(program, bench_config(axes="XYZ"))
    path = np.column_stack([reference.position_mm[axis] for axis in plane])
    on = np.hypot(*path.T) > 9.0
    angle = np.unwrap(np.arctan2(path[on, 1], path[on, 0]))
    assert angle.max() == pytest.approx(4 * np.pi, abs=0.01)
    assert angle[-1] == pytest.approx(0.0, abs=0.01)
    assert evaluate_circle(path, 10.0, (0.0, 0.0)).hysteresis_um < 1.0
