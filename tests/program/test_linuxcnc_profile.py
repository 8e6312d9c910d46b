"""The profile that plans like LinuxCNC, compared with the known results of its rules, without LinuxCNC itself."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fdhil.config import MachineConfig, parse_config
from fdhil.program import Arc, Dwell, Feed, Motion, Rapid, interpret, plan
from fdhil.program.motions import Corner
from fdhil.program.planner import stream_trajectory
from fdhil.program.planner.linuxcnc.line_joining import join_short_feeds
from fdhil.records import Float
from tests.bench import bench_document
from tests.program.test_look_ahead import generate_moves, sample_path
from tests.program.test_planner import require_equal_blocks

ACCELERATION_MM_S2 = 2000.0
INTERPOLATED_ROWS = 2
STOP_MM = 1e-3  # a stop of one cycle after the joints' interpolation over three points
EXACT_PATH, EXACT_STOP = Corner("exact_path", 0.0), Corner("exact_stop", 0.0)


def build_machine(**keys: object) -> MachineConfig:
    document = bench_document("XYZ")
    for axis in document["axis"].values():
        axis["max_acceleration_mm_s2"] = ACCELERATION_MM_S2
    document["nc"] = {"profile": "linuxcnc", "end_rest_s": 0.0, **keys}
    return parse_config(document)


def plan_rows(moves: list[Motion], **keys: object) -> Float:
    return np.column_stack(list(plan(moves, build_machine(**keys)).position_mm.values()))


def compute_accelerations(rows: Float) -> Float:
    return np.diff(np.concatenate([np.repeat(rows[:1], 3, axis=0), rows]), 2, axis=0) / 1e-6


def test_single_line_uses_half_acceleration_under_g64_and_full_under_g61() -> None:
    """The last motion under G64 could still be blended, so it uses half."""
    for corner, acceleration in ((Corner("blend", 0.05), 1000.0), (EXACT_PATH, 2000.0)):
        rows = plan_rows([Feed(1, (100.0, 0.0, 0.0), 6000.0, corner)])
        assert rows[-1] == pytest.approx([100.0, 0.0, 0.0], abs=1e-9)
        expected_s = 1.0 + 100.0 / acceleration
        assert len(rows) == pytest.approx(1000 * expected_s + INTERPOLATED_ROWS, abs=2)
        assert np.abs(compute_accelerations(rows)).max() == pytest.approx(acceleration, rel=1e-6)


def test_g61_corner_stops_with_tenth_of_acceleration_reserved() -> None:
    moves: list[Motion] = [
        Feed(1, (50.0, 0.0, 0.0), 6000.0, EXACT_PATH), Feed(2, (50.0, 50.0, 0.0), 6000.0, EXACT_PATH)
    ]  # fmt: skip
    rows = plan_rows(moves)
    assert np.linalg.norm(rows - [50.0, 0.0, 0.0], axis=1).min() < STOP_MM
    assert np.abs(compute_accelerations(rows)).max() == pytest.approx(1800.0, rel=1e-6)


def test_g64_p_corner_is_widest_arc_within_tolerance() -> None:
    """At 90 degrees R (sqrt 2 - 1) = P, and v2 / R is sqrt(3) / 2 of the acceleration."""
    tolerance = 0.5
    corner = Corner("blend", tolerance)
    rows = plan_rows([Feed(1, (50.0, 0.0, 0.0), 20000.0, corner), Feed(2, (50.0, 50.0, 0.0), 20000.0, corner)])
    assert np.linalg.norm(rows - [50.0, 0.0, 0.0], axis=1).min() == pytest.approx(tolerance, abs=2e-3)
    radius = tolerance / (math.sqrt(2.0) - 1.0)
    centre = np.array([50.0 - radius, radius])
    turning = (rows[:, 0] > centre[0]) & (rows[:, 1] < centre[1])
    speed = np.linalg.norm(np.diff(rows, axis=0), axis=1)[turning[:-1]] / 1e-3
    assert np.median(speed) == pytest.approx(math.sqrt(math.sqrt(0.75) * ACCELERATION_MM_S2 * radius), rel=1e-3)


def test_circle_keeps_normal_share_and_half_acceleration_along() -> None:
    circle = Arc(1, (0.0, 0.0, 0.0), (20.0, 0.0, None), -1, "XY", 60000.0, EXACT_STOP)
    rows = plan_rows([circle])
    speed = np.linalg.norm(np.diff(rows, axis=0), axis=1) / 1e-3
    assert speed.max() == pytest.approx(math.sqrt(math.sqrt(0.75) * ACCELERATION_MM_S2 * 20.0), rel=1e-3)
    assert np.diff(speed)[5:40] / 1e-3 == pytest.approx(1000.0, rel=2e-3)
    assert np.linalg.norm(compute_accelerations(rows), axis=1).max() <= ACCELERATION_MM_S2 * 1.001


def test_parabola_next_to_helix_overlaps_both_segments() -> None:
    """A line and a helix are not in one plane, so no arc fits; both use half then, and the corner is cut by P."""
    corner = Corner("blend", 0.05)
    moves: list[Motion] = [
        Feed(1, (40.0, 0.0, 0.0), 6000.0, corner),
        Arc(2, (40.0, 0.0, -10.0), (20.0, 0.0, None), -1, "XY", 6000.0, corner),
        Feed(3, (0.0, 0.0, -10.0), 6000.0, corner),
    ]
    rows = plan_rows(moves)
    near = np.linalg.norm(rows - [40.0, 0.0, 0.0], axis=1)
    assert 0.02 < near.min() <= 0.06
    along = np.diff(np.linalg.norm(np.diff(rows, axis=0), axis=1)) / 1e-6
    assert np.abs(along[20:80]).max() == pytest.approx(1000.0, rel=1e-6)


@pytest.mark.parametrize(
    ("path", "tolerance", "feed", "rows"),
    [
        ("G3 X20 Y0 R12|G2 X40 Y0 R12|G3 X60 Y5 R15", 0.05, 6000, 923),
        ("G3 X20 Y0 R12|G2 X40 Y0 R12|G3 X60 Y5 R15", 0.5, 10000, 735),
        ("G3 X20 Y0 R30|G3 X0 Y0 R30|G3 X20 Y0 R30", 0.2, 20000, 1133),  # too sharp for an arc
        ("G1 X10|G3 X30 Y0 R12|G2 X30 Y30 R20|G1 X0|G3 X0 Y10 R10.5", 0.2, 20000, 1330),
    ],
)
def test_arc_corners_match_measured_time(path: str, tolerance: float, feed: int, rows: int) -> None:
    """Rows of LinuxCNC 2.9's own demand for these programs, within two cycles."""
    text = f"G64 P{tolerance}|F{feed}|{path}"
    assert len(plan_rows(list(interpret(text.split("|"))))) == pytest.approx(rows + INTERPOLATED_ROWS, abs=3)


def test_rapid_and_feed_are_separated_by_stop() -> None:
    moves: list[Motion] = [Rapid(1, (50.0, 0.0, 0.0)), Feed(2, (50.0, 20.0, 0.0), 6000.0), Dwell(3, 0.25),
                           Feed(4, (60.0, 20.0, 0.0), 6000.0)]  # fmt: skip
    reference = plan(moves, build_machine())
    rows = np.column_stack(list(reference.position_mm.values()))
    assert np.linalg.norm(rows - [50.0, 0.0, 0.0], axis=1).min() < STOP_MM
    assert np.count_nonzero(np.linalg.norm(rows - [50.0, 20.0, 0.0], axis=1) < 1e-9) >= 250 - INTERPOLATED_ROWS
    assert reference.rapid[1]
    assert set(reference.line.tolist()) == {0, 1, 2, 3, 4}


def test_short_lines_are_joined_within_q() -> None:
    """A sine in chords, at most 0.05 off a line; without Q only collinear chords are joined."""
    text = "G64 P0.05 Q0.05\nF6000\n" + "".join(f"G1 X{0.4 * n:.4f} Y{math.sin(0.08 * n):.4f}\n" for n in range(1, 200))
    moves = list(interpret(text.splitlines()))
    kept = list(join_short_feeds(moves))
    assert len(kept) < len(moves) / 4
    ends = np.array([(0.0, 0.0, 0.0), *(m.end for m in kept if isinstance(m, Feed))])
    line = np.concatenate([np.linspace(a, b, 2000) for a, b in pairwise(ends)])
    places = np.array([m.end for m in moves if isinstance(m, Feed)])
    assert np.max(cKDTree(line).query(places)[0]) <= 0.05 + 1e-3
    exact = list(interpret(text.replace(" Q0.05", " Q0").splitlines()))
    assert len(list(join_short_feeds(exact))) == len(exact)
    straight = ["G64 P0.05 Q0", "F6000", *(f"G1 X{n}" for n in range(1, 9)), "G0 Y5"]
    assert [m.line for m in join_short_feeds(interpret(straight))] == [10, 11]


@pytest.mark.usefixtures("long_computation")
def test_path_deviates_at_most_p_and_reaches_end() -> None:
    config = build_machine()
    furthest = 0.0
    for seed in range(12):
        moves = [Feed(m.line, m.end, m.feed, Corner("blend", 0.1)) for m in generate_moves(seed) if isinstance(m, Feed)]
        rows = plan_rows(list(moves))
        assert rows[-1] == pytest.approx(moves[-1].end, abs=1e-9)
        furthest = max(furthest, float(np.max(cKDTree(sample_path(moves, config)).query(rows[:, :2])[0])))
    assert 0.05 <= furthest <= 0.11  # the joints' interpolation adds to P at the sharpest corners


def test_reference_is_independent_of_block_length() -> None:
    require_equal_blocks(
        [*generate_moves(3, 90), Dwell(301, 0.1), Rapid(302, (0.0, 0.0, 0.0))], build_machine(), atol=0.0
    )


def list_chords(count: int) -> Iterator[Motion]:
    for number in range(count):
        end = (0.3 * number, 0.2 * (number % 2), 0.0)
        yield Feed(number + 1, end, 6000.0, Corner("blend", 0.01))


@pytest.mark.usefixtures("long_computation")
def test_long_program_is_planned_in_constant_memory() -> None:
    peaks = []
    for count in (150, 600):
        tracemalloc.start()
        for _ in stream_trajectory(list_chords(count), build_machine(), 500):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]
