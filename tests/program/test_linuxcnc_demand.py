"""The profiles compared with the demand of LinuxCNC's own planner, millisecond by millisecond.

The profile ``linuxcnc`` reproduces it. The trapezoidal one uses the axes' full limits: LinuxCNC accelerates with 0.9 of
the joints' acceleration if a motion ends exactly, with all of it if it blends by an arc, and with half of it if it
blends by a parabola (measured on the package's version); therefore G64 is compared by path and time only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fdhil.config import MachineConfig, parse_config
from fdhil.correction import mirror
from fdhil.correction import plan_correction as correct
from fdhil.prediction import predict_corrected_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import Dwell, interpret, plan
from fdhil.records import Float
from tests.bench import bench_config, bench_document
from tests.linuxcnc.linuxcnc_process import DemandRecorder
from tests.paths import build_trajectory, compute_rms
from tests.program.test_look_ahead import sample_path

pytestmark = pytest.mark.debian

Theirs = Callable[..., Float]
ACCELERATION_MM_S2 = 2000.0
EXACT_SHARE = 0.9
PATHS = {
    "contour": "G1 X50\nY30\nG3 X30 Y50 I-20\nG1 X0\nY0\n",
    "zigzag": "".join(f"G1 X{10 * n} Y{15 * (n % 2)}\n" for n in range(1, 9)),
    "helix": "G1 X40\nG2 X40 Y0 Z-10 I-20\nG1 X0\n",
}


def build_program(path: str, mode: str, feed: float) -> str:
    return f"G21 G90 G17 {mode}\nF{feed:g}\n{PATHS[path]}M2\n"


def build_machine(acceleration_mm_s2: float, profile: str = "trapezoidal") -> MachineConfig:
    document = bench_document("XYZ")
    for axis in document["axis"].values():
        axis["max_acceleration_mm_s2"] = acceleration_mm_s2
    document["nc"] = {"profile": profile, "rapid_stop": False, "end_rest_s": 0.0}
    return parse_config(document)


def plan_demand(text: str, acceleration_mm_s2: float = ACCELERATION_MM_S2, profile: str = "trapezoidal") -> Float:
    reference = plan(interpret(text.splitlines()), build_machine(acceleration_mm_s2, profile))
    rows = np.column_stack(list(reference.position_mm.values()))
    moving = np.flatnonzero(np.abs(np.diff(rows, axis=0)).max(axis=1) > 1e-9)
    return np.asarray(rows[: moving[-1] + 2])


@contextmanager
def open_recorder(axes: str) -> Iterator[Theirs]:
    """LinuxCNC's rows for a program; more than ``most_rows`` or fewer than ``least_rows`` are recorded again, twice.

    A busy computer may delay its interpreter, so that its planner has nothing to look ahead to and brakes, or the
    reader of the samples, so that some are lost.
    """
    with DemandRecorder(acceleration_mm_s2=ACCELERATION_MM_S2, axes=axes) as nc:

        def record_demand(text: str, most_rows: float, least_rows: float = 0.0) -> Float:
            for _ in range(3):
                if least_rows <= len(rows := nc.record_demand(text)) <= most_rows:
                    break
            return rows

        yield record_demand


@pytest.fixture(scope="module")
def record_reference() -> Iterator[Theirs]:
    with open_recorder("XYZ") as recorded:
        yield recorded


def measure_distance_mm(a: Float, b: Float) -> float:
    """Largest distance of two demands at the same millisecond."""
    rows = min(len(a), len(b))
    return float(np.linalg.norm(a[:rows] - b[:rows], axis=1).max())


@pytest.mark.parametrize("path", ["contour", "zigzag"])
def test_g61_matches_linuxcnc_positions_and_time(path: str, record_reference: Theirs) -> None:
    text = build_program(path, "G61", 6000.0)
    a = plan_demand(text, EXACT_SHARE * ACCELERATION_MM_S2)
    b = record_reference(text, 1.006 * len(a), 0.994 * len(a))
    assert len(a) == pytest.approx(len(b), rel=0.006)
    per_corner_s = 0.0015  # about a cycle of the other planner at each stop, and one at the start
    assert measure_distance_mm(a, b) <= 100.0 * per_corner_s * PATHS[path].count("\n")


# on a circle LinuxCNC reserves 1 / sqrt(3) of the acceleration for the path at any feed, fdhil the unused part;
# if the feed exceeds the circle's limit, LinuxCNC uses all of the acceleration and not 0.9 of it
@pytest.mark.parametrize(
    ("path", "feed", "share"),
    [("helix", 6000.0, 0.015), ("contour", 20000.0, 0.012), ("zigzag", 20000.0, 0.012), ("helix", 20000.0, 0.055)],
)
def test_g61_matches_linuxcnc_duration_on_circles(
    path: str, feed: float, share: float, record_reference: Theirs
) -> None:
    text = build_program(path, "G61", feed)
    rows = len(plan_demand(text, EXACT_SHARE * ACCELERATION_MM_S2))
    assert rows == pytest.approx(len(record_reference(text, (1.0 + share) * rows, (1.0 - share) * rows)), rel=share)


@pytest.mark.parametrize("path", ["contour", "zigzag"])
@pytest.mark.parametrize(
    ("tolerance_mm", "feed", "share"), [(0.05, 3000.0, 0.02), (0.5, 3000.0, 0.02), (0.05, 1e4, 0.08)]
)
def test_g64_stays_within_p_and_matches_duration(
    path: str, tolerance_mm: float, feed: float, share: float, record_reference: Theirs
) -> None:
    text = build_program(path, f"G64 P{tolerance_mm:g}", feed)
    a = plan_demand(text)
    b = record_reference(text, (1.0 + share) * len(a), (1.0 - share) * len(a))
    config = build_machine(ACCELERATION_MM_S2)
    programmed = sample_path([m for m in interpret(text.splitlines()) if not isinstance(m, Dwell)], config)
    tree = cKDTree(programmed)
    for rows in (a, b):
        assert np.max(tree.query(rows[:, :2])[0]) <= tolerance_mm + 0.003
    assert len(a) == pytest.approx(len(b), rel=share)


def build_polygon(seed: int, count: int = 14) -> str:
    """Lines of 2 to 40 mm in random directions."""
    random = np.random.default_rng(seed)
    ways = random.normal(size=(count, 3)) * [1.0, 1.0, 0.3]
    places = np.cumsum(ways / np.linalg.norm(ways, axis=1)[:, None] * random.uniform(2.0, 40.0, (count, 1)), axis=0)
    return "".join(f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f}\n" for x, y, z in places)


def build_wave(step_mm: float, height_mm: float, count: int = 150) -> str:
    """A sine in chords."""
    return "".join(
        f"G1 X{step_mm * n:.4f} Y{height_mm * math.sin(0.1 * step_mm * n):.4f}\n" for n in range(1, count + 1)
    )


PATHS |= {
    "polygon 1": build_polygon(101),
    "polygon 2": build_polygon(203),
    "wave": build_wave(0.3, 4.0),
    "coarse wave": build_wave(1.5, 8.0, 60),
    "pockets": "G1 X30\nY10\nG2 X40 Y20 I10\nG1 X60\nG3 X70 Y10 J-10\nG1 Y-20\nG0 X0 Y0\nG1 Z-5\n",
    "arcs": "G1 X10\nG3 X30 Y0 R12\nG2 X30 Y30 R20\nG1 X0\nG3 X0 Y10 R10.5\n",
    "lenses": "G3 X20 Y0 R30\nG3 X0 Y0 R30\nG3 X20 Y0 R12\nG2 X40 Y0 R12\nG3 X60 Y5 R15\n",
    "ramp": "G1 X30\nG3 X30 Y0 Z-6 I-12 P2\nG1 X0 Y20\n",
}


@pytest.mark.parametrize(("mode", "feed"), [("G61", 2e4), ("G64 P0.05", 6e3), ("G64 P0.2 Q0.02", 2e4)])
@pytest.mark.parametrize("path", PATHS)
def test_linuxcnc_profile_matches_recorded_demand(path: str, mode: str, feed: float, record_reference: Theirs) -> None:
    """Within 2 % of its time, and on its path up to the distance of one cycle."""
    text = build_program(path, mode, feed)
    a = plan_demand(text, profile="linuxcnc")
    b = record_reference(text, 1.02 * len(a))
    assert len(a) == pytest.approx(len(b), rel=0.02)
    assert measure_path_distance_mm(a, b) <= 0.02
    assert measure_path_distance_mm(b, a) <= 0.02


def measure_path_distance_mm(places: Float, path: Float) -> float:
    """Largest distance of points from a path through points, refined to a hundredth of a cycle."""
    share = np.linspace(0.0, 1.0, 100, endpoint=False)[:, None, None]
    fine = (path[:-1] + share * (path[1:] - path[:-1])).reshape(-1, 3)
    return float(np.max(cKDTree(np.concatenate([fine, path[-1:]])).query(places)[0]))


def test_correction_handles_steps_of_acceleration(record_reference: Theirs) -> None:
    """The bench path by G64 without P: steps of acceleration, rounded to the drives' increments."""
    text = "G21 G90 G17 G64\nF10000\nG1 Y55\nX100\nG3 X200 I50\nG1 X250\nY0\nM2\n"
    rows = record_reference(text, math.inf)[:, :2]
    reference = build_trajectory(np.round(np.concatenate([rows, np.repeat(rows[-1:], 500, axis=0)]) * 3276.8) / 3276.8)
    config = bench_config()
    models = build_nominal_models(config)
    correction = correct(reference, models, config, "inverse")
    assert not correction.refused
    mirrored = mirror.plan_mirror_offsets(reference, models, config, correction.before).offset_um
    left = compute_rms(correction.after.contour_um)
    assert compute_rms(correction.before.contour_um) >= 14 * left
    assert compute_rms(predict_corrected_path(reference, models, config, mirrored).contour_um) >= 2 * left
