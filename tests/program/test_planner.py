"""The planner: times, speeds, stops and the smoothing of the NC."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from fdhil.config import MachineConfig, parse_config
from fdhil.errors import ProgramError
from fdhil.program import Arc, Dwell, Feed, Motion, Rapid, interpret, plan
from fdhil.program.planner import stream_trajectory
from tests.bench import bench_config, bench_document

MOVES: list[Motion] = [
    Feed(1, (0.0, 55.0, 0.0), 10000.0),
    Feed(2, (100.0, 55.0, 0.0), 10000.0),
    Arc(3, (200.0, 55.0, 0.0), (150.0, 55.0, None), 1, "XY", 10000.0),
    Feed(4, (250.0, 55.0, 0.0), 10000.0),
    Rapid(5, (0.0, 0.0, 0.0)),
]


PROFILES = ("fir", "trapezoidal", "jerk_limited", "linuxcnc")


def plan_with_profile(profile: str) -> MachineConfig:
    document = bench_document()
    document["nc"] = {"profile": profile}
    return parse_config(document)


def test_feed_is_programmed_speed_after_two_moving_averages() -> None:
    reference = plan([Feed(1, (100.0, 0.0, 0.0), 6000.0)], bench_config())
    raw = np.minimum(np.arange(1000 + 88 + 2 + 500) * 0.1, 100.0)
    expected = raw
    for length in (60, 30):
        expected = np.convolve(np.concatenate([np.zeros(length - 1), expected]), np.full(length, 1 / length), "valid")
    np.testing.assert_allclose(reference.position_mm["X"], expected, atol=1e-9)
    np.testing.assert_array_equal(reference.position_mm["Y"], 0.0)
    assert reference.line[0] == 0
    assert set(reference.line[1:]) == {1}
    assert not reference.rapid.any()


@pytest.mark.parametrize("profile", PROFILES)
def test_arc_is_limited_only_by_its_axes(profile: str) -> None:
    document = bench_document("XYZ")
    document["nc"] = {"profile": profile}
    document["axis"]["Z"]["rapid_speed_mm_s"] = 50.0
    arc = [Arc(1, (200.0, 0.0, 0.0), (100.0, 0.0, None), 1, "XY", 6000.0)]
    reference = plan(arc, parse_config(document))
    speed = np.hypot(np.diff(reference.position_mm["X"]), np.diff(reference.position_mm["Y"])) / 1e-3
    assert speed.max() == pytest.approx(100.0, rel=0.01)


def test_path_keeps_programmed_feed_between_feeds() -> None:
    document = bench_document()
    document["nc"] = {"smoothing_s": [], "end_rest_s": 0.0}
    reference = plan(MOVES[:4], parse_config(document))
    x, y = reference.position_mm["X"], reference.position_mm["Y"]
    speed = np.hypot(np.diff(x), np.diff(y)) / 1e-3
    length = 55 + 100 + 50 * math.pi + 50
    assert reference.time_s[-1] == pytest.approx(length / (10000 / 60), abs=2.1e-3)
    moving = speed[: -round(0.5 / 1e-3)]  # the reference is held at its end
    assert np.quantile(moving, 0.01) == pytest.approx(10000 / 60, rel=1e-4)
    assert y.min() >= 0.0
    assert y[np.abs(x - 150) < 0.1] == pytest.approx(5.0, abs=0.01)  # the lower half of the circle


def test_rapids_keep_axis_limits_and_are_straight() -> None:
    document = bench_document()
    document["nc"] = {"smoothing_s": []}
    document["axis"]["Y"]["max_acceleration_mm_s2"] = 1000.0
    reference = plan([Rapid(1, (300.0, 200.0, 0.0))], parse_config(document))
    x, y = reference.position_mm["X"], reference.position_mm["Y"]
    np.testing.assert_allclose(y, x * 2 / 3, atol=1e-9)
    assert np.abs(np.diff(x)).max() <= 0.5 + 1e-9
    assert np.abs(np.diff(y, 2)).max() <= 1000e-6 + 1e-9
    assert np.abs(np.diff(y, 2)).max() >= 990e-6
    assert (x[-1], y[-1]) == (300.0, 200.0)
    assert reference.rapid[1:].all()


def test_rapid_and_feed_are_separated_by_exact_stop() -> None:
    reference = plan(MOVES, bench_config())
    x, y = reference.position_mm["X"], reference.position_mm["Y"]
    first_rapid = int(np.argmax(reference.rapid))
    assert (x[first_rapid - 1], y[first_rapid - 1]) == pytest.approx((250.0, 55.0), abs=1e-9)
    assert not reference.rapid[0]
    assert (x[-1], y[-1]) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_exact_stop_between_feeds_is_configurable() -> None:
    document = bench_document()
    document["nc"] = {"corner": "exact_stop", "settle_s": 0.01}
    reference = plan(MOVES[:2], parse_config(document))
    corner = np.hypot(reference.position_mm["X"], reference.position_mm["Y"] - 55.0)
    assert np.count_nonzero(corner < 1e-9) >= 10


def test_a_dwell_holds_all_axes() -> None:
    reference = plan(
        [Feed(1, (10.0, 0.0, 0.0), 6000.0), Dwell(2, 0.5), Feed(3, (20.0, 0.0, 0.0), 6000.0)], bench_config()
    )
    assert np.count_nonzero(np.abs(reference.position_mm["X"] - 10.0) < 1e-9) >= 500
    assert reference.time_s[-1] == pytest.approx(0.1 + 0.088 + 0.5 + 0.088 + 0.1 + 0.088 + 0.5, abs=0.003)


def require_equal_blocks(moves: Sequence[Motion], config: MachineConfig, atol: float = 1e-9) -> None:
    whole = plan(moves, config)
    blocks = list(stream_trajectory(moves, config, 333))
    assert {block.time_s.size for block in blocks[:-1]} == {333}
    for axis in whole.axes:
        joined = np.concatenate([block.position_mm[axis] for block in blocks])
        np.testing.assert_allclose(joined, whole.position_mm[axis], atol=atol)
    np.testing.assert_array_equal(np.concatenate([block.line for block in blocks]), whole.line)
    np.testing.assert_array_equal(np.concatenate([block.rapid for block in blocks]), whole.rapid)


@pytest.mark.parametrize("profile", PROFILES)
def test_streamed_blocks_match_reference(profile: str) -> None:
    require_equal_blocks([*MOVES, Dwell(6, 0.25), *MOVES], plan_with_profile(profile))


@pytest.mark.parametrize("profile", PROFILES)
def test_an_axis_that_the_machine_lacks_is_refused(profile: str) -> None:
    with pytest.raises(ProgramError, match="axis Z") as caught:
        plan([Rapid(7, (0.0, 0.0, 1.0))], plan_with_profile(profile))
    assert caught.value.line == 7


def test_unmoved_axes_stay_at_rest_position() -> None:
    reference = plan([Feed(1, (10.0, 0.0, 0.0), 6000.0)], bench_config("XYZ"))
    assert reference.axes == ("X", "Y", "Z")
    assert not reference.position_mm["Z"].any()


@pytest.mark.parametrize("profile", PROFILES)
def test_empty_program_is_at_rest(profile: str) -> None:
    assert not plan([], plan_with_profile(profile)).position_mm["X"].any()


@pytest.mark.parametrize("profile", PROFILES)
def test_endless_duration_is_refused(profile: str) -> None:
    for move in (Dwell(1, 1e300), Feed(1, (1.0, 0.0, 0.0), 0.0)):
        with pytest.raises(ProgramError):
            plan([move], plan_with_profile(profile))
    with pytest.raises(ProgramError, match="h; split"):
        plan([Feed(1, (1000.0, 0.0, 0.0), 1e-6)], plan_with_profile(profile))


def test_helices_and_spirals_reach_programmed_end() -> None:
    config = bench_config("XYZ")
    start = Feed(1, (10.0, 0.0, 0.0), 6000.0)
    reference = plan([start, Arc(2, (10.001, 0.0, 5.0), (0.0, 0.0, None), -3, "XY", 6000.0)], config)
    end = [reference.position_mm[axis][-1] for axis in "XYZ"]
    assert end == pytest.approx([10.001, 0.0, 5.0], abs=1e-9)
    angle = np.unwrap(np.arctan2(reference.position_mm["Y"], reference.position_mm["X"]))[300:]
    assert angle[-1] == pytest.approx(-6 * math.pi, abs=1e-6)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize(
    ("text", "most", "linuxcnc_s"),
    [  # duration in LinuxCNC 2.9, headless, with [TRAJ] MAX_LINEAR_VELOCITY at this speed
        ("G0 X150 Y150", 100.0, 2.195),
        ("G64 P0.1|G1 X60 Y60 F12000|X120 Y0", 80.0, 2.204),
        ("G64 P0.1|G1 F12000|G2 X40 I20|G3 X80 I20|G1 X120", 60.0, 2.841),
    ],
)
def test_path_speed_keeps_nc_limit(profile: str, text: str, most: float, linuxcnc_s: float) -> None:
    document = bench_document("XYZ")
    document["nc"] = {"profile": profile, "max_path_speed_mm_s": most, "end_rest_s": 0.0}
    for axis in document["axis"].values():
        axis |= {"rapid_speed_mm_s": 100.0, "max_acceleration_mm_s2": 2000.0}
    step_mm = np.linalg.norm(
        np.diff(plan(list(interpret(text.split("|"))), parse_config(document)).path_mm, axis=0), axis=1
    )
    assert step_mm.max() / 0.001 == pytest.approx(most, rel=1e-3)
    moving = np.flatnonzero(step_mm > 0.0)
    if profile == "linuxcnc":
        assert (moving[-1] - moving[0] + 2) * 0.001 == pytest.approx(linuxcnc_s, abs=0.005)


@pytest.mark.parametrize("profile", PROFILES)
def test_motion_of_unplanned_axis_is_refused_with_line(profile: str) -> None:
    """Missing, or configured in mm; a word that keeps the axis in place orders nothing."""
    document = bench_document("XYA")
    document["nc"] = {"profile": profile}
    config = parse_config(document)
    assert plan(list(interpret(["G0 X10 A0", "G1 Y5 A0 F1000"])), config).position_mm["A"].max() == 0.0
    for text in ("A5", "X20 A5", "B1"):
        with pytest.raises(ProgramError, match=f"line 2, '{text[-2]}': moves axis {text[-2]}, which.*unit = \"deg\""):
            plan(list(interpret(["G0 X10", f"G1 {text} F1000"])), config)
