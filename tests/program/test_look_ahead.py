"""The look-ahead profiles: every limit kept, corners according to G61, G61.1 and G64 P, constant memory."""

from __future__ import annotations

import hashlib
import math
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fdhil.config import MachineConfig, parse_config
from fdhil.correction import block_streaming
from fdhil.correction import plan_correction as correct
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.program import Arc, Dwell, Feed, Motion, Rapid, plan
from fdhil.program.motions import BLEND, ORIGIN, Corner, Place, compute_end
from fdhil.program.planner import stream_trajectory
from fdhil.program.planner.axis_limits import AxisLimits
from fdhil.program.planner.path_pieces import LENGTH, build_piece, compute_points
from fdhil.records import Float, Trajectory
from tests.bench import bench_config, bench_document
from tests.paths import compute_rms
from tests.program.test_planner import MOVES, require_equal_blocks

DT_S = 1e-3
PROFILES = ("trapezoidal", "jerk_limited")
EXACT_PATH, EXACT_STOP = Corner("exact_path", 0.0), Corner("exact_stop", 0.0)


def build_machine(profile: str, axes: str = "XY", **keys: object) -> MachineConfig:
    document = bench_document(axes)
    document["nc"] = {"profile": profile, **keys}
    document["axis"]["Y"]["max_acceleration_mm_s2"] = 2500.0  # so that the axes differ
    document["axis"]["X"]["max_jerk_mm_s3"] = 150_000.0
    return parse_config(document)


def build_corner(moves: Sequence[Motion], corner: Corner) -> list[Motion]:
    return [move if isinstance(move, Dwell) else replace(move, corner=corner) for move in moves]


def generate_moves(seed: int, count: int = 12) -> list[Motion]:
    """Lines and half circles of 0.1 to 30 mm in random directions, with changing feeds."""
    random = np.random.default_rng(seed)
    at = np.zeros(2)
    moves: list[Motion] = []
    for number in range(count):
        heading = random.uniform(0.0, 2.0 * math.pi)
        end = at + 10 ** random.uniform(-1.0, 1.5) * np.array([math.cos(heading), math.sin(heading)])
        feed = float(random.choice([1000.0, 6000.0, 20000.0]))
        if number % 3 == 2:
            centre = (float(at[0] + end[0]) / 2.0, float(at[1] + end[1]) / 2.0, None)
            moves.append(Arc(number, (*end.tolist(), 0.0), centre, int(random.choice([1, -1])), "XY", feed))
        else:
            moves.append(Feed(number, (*end.tolist(), 0.0), feed))
        at = end
    return moves


def sample_path(moves: Sequence[Motion], config: MachineConfig) -> Float:
    at: Place = ORIGIN
    parts = []
    for move in moves:
        assert not isinstance(move, Dwell)
        row = np.array(build_piece(move, at, AxisLimits.create_from_config(config)))
        share = np.linspace(0.0, row[LENGTH], 10001)
        parts.append(compute_points(np.repeat(row[None], share.size, axis=0), share))
        at = compute_end(move, at)
    return np.concatenate(parts)[:, :2]


def stack_columns(reference: Trajectory) -> Float:
    return np.column_stack([reference.position_mm[axis] for axis in reference.axes])


def require_limits_kept(reference: Trajectory, config: MachineConfig) -> None:
    """Speed, acceleration and, for jerk_limited, jerk of every axis, as differences of the demand."""
    for axis, path in reference.position_mm.items():
        settings = config.axis[axis]
        whole = np.concatenate([np.repeat(path[:1], 3), path])
        assert np.abs(np.diff(whole)).max() / DT_S <= settings.rapid_speed_mm_s * (1 + 1e-6)
        assert np.abs(np.diff(whole, 2)).max() / DT_S**2 <= settings.max_acceleration_mm_s2 * (1 + 1e-4)
        if config.nc.profile == "jerk_limited":
            assert np.abs(np.diff(whole, 3)).max() / DT_S**3 <= settings.jerk_mm_s3 * (1 + 1e-4)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("corner", [EXACT_PATH, EXACT_STOP, BLEND, Corner("blend", 0.05)], ids=str)
def test_all_axes_keep_their_limits(profile: str, corner: Corner) -> None:
    config = build_machine(profile)
    for moves in (MOVES, *(generate_moves(seed) for seed in range(8))):
        reference = plan(build_corner(moves, corner), config)
        require_limits_kept(reference, config)
        last = moves[-1]
        assert not isinstance(last, Dwell)
        np.testing.assert_allclose(stack_columns(reference)[-1], last.end[:2], atol=1e-9)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("tolerance_mm", [0.0, 0.01, 0.1])
def test_path_deviates_at_most_p(profile: str, tolerance_mm: float) -> None:
    config = build_machine(profile)
    furthest = 0.0
    for seed in range(8):
        moves = generate_moves(seed)
        corner = Corner("blend", tolerance_mm) if tolerance_mm else EXACT_PATH
        reference = stack_columns(plan(build_corner(moves, corner), config))
        furthest = max(furthest, float(np.max(cKDTree(sample_path(moves, config)).query(reference)[0])))
    sampling_mm = 0.003  # finest resolution of an arc of 50 mm
    assert furthest <= tolerance_mm + sampling_mm
    assert furthest >= 0.6 * tolerance_mm


@pytest.mark.parametrize("profile", PROFILES)
def test_wider_tolerance_is_faster(profile: str) -> None:
    config = build_machine(profile)
    moves = [move for move in MOVES if not isinstance(move, Rapid)]
    corners = (EXACT_STOP, Corner("blend", 0.02), Corner("blend", 0.2), BLEND)
    times = [float(plan(build_corner(moves, corner), config).time_s[-1]) for corner in corners]
    assert times[1:] == sorted(times[1:], reverse=True)
    assert times[0] - times[-1] > 0.08


def test_trapezoid_has_expected_duration() -> None:
    document = bench_document()
    document["nc"] = {"profile": "trapezoidal", "end_rest_s": 0.0}
    reference = plan([Feed(3, (100.0, 0.0, 0.0), 6000.0)], parse_config(document))
    assert reference.time_s[-1] == pytest.approx(100.0 / 100.0 + 100.0 / 4000.0, abs=2e-3)
    t = reference.time_s
    np.testing.assert_allclose(reference.position_mm["X"][:26], 2000.0 * t[:26] ** 2, atol=1e-9)
    assert reference.line[0] == 0
    assert set(reference.line[1:]) == {3}


def test_jerk_limited_ramp_is_s_shaped() -> None:
    config = build_machine("jerk_limited")
    reference = plan([Feed(1, (100.0, 0.0, 0.0), 6000.0)], config)
    acceleration = np.diff(reference.position_mm["X"], 2) / DT_S**2
    steps = np.abs(np.diff(acceleration))
    assert steps.max() <= 150_000.0 * DT_S * (1 + 1e-6)
    assert acceleration.max() > 1000.0


def test_g61_1_stops_at_corner_and_g61_reaches_it() -> None:
    config = build_machine("trapezoidal", settle_s=0.02)
    corner = np.array([0.0, 55.0])
    for mode, rows in ((EXACT_STOP, 20), (EXACT_PATH, 1)):
        reference = stack_columns(plan(build_corner(MOVES[:2], mode), config))
        distance = np.linalg.norm(reference - corner, axis=1)
        assert distance.min() < 5e-3
        assert np.count_nonzero(distance < 1e-9) >= rows - 1
    blended = stack_columns(plan(build_corner(MOVES[:2], Corner("blend", 0.1)), config))
    assert 0.05 < np.linalg.norm(blended - corner, axis=1).min() <= 0.1 * 1.02


def test_configured_exact_stop_applies_everywhere() -> None:
    reference = plan(MOVES[:2], build_machine("trapezoidal", corner="exact_stop", settle_s=0.01))
    assert np.count_nonzero(np.linalg.norm(stack_columns(reference) - [0.0, 55.0], axis=1) < 1e-9) >= 10


def test_rapid_and_feed_are_separated_by_stop_unless_blended() -> None:
    moves: list[Motion] = [Rapid(1, (50.0, 0.0, 0.0)), Feed(2, (50.0, 50.0, 0.0), 6000.0)]
    nearest = []
    for stop in (True, False):
        reference = stack_columns(plan(moves, build_machine("trapezoidal", rapid_stop=stop)))
        nearest.append(float(np.linalg.norm(reference - [50.0, 0.0], axis=1).min()))
    assert nearest[0] < 1e-9
    assert nearest[1] > 0.1


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("profile", PROFILES)
def test_reference_is_independent_of_block_length(profile: str) -> None:
    config = build_machine(profile)
    moves = [*generate_moves(3, 700), Dwell(701, 0.25), *MOVES]
    require_equal_blocks(moves, config)
    require_limits_kept(plan(moves, config), config)


def generate_zigzag(count: int) -> Iterator[Motion]:
    for number in range(count):
        yield Feed(number, (0.3 * (number % 2), 0.2 * (number % 2), 0.0), 3000.0, Corner("blend", 0.01))


@pytest.mark.usefixtures("long_computation")
def test_long_program_is_planned_in_constant_memory() -> None:
    config = build_machine("jerk_limited")
    peaks = []
    for count in (3000, 9000):
        tracemalloc.start()
        for _ in stream_trajectory(generate_zigzag(count), config, 1000):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def test_short_blocks_reach_the_feed() -> None:
    """A circle in chords of 0.1 mm: the look-ahead is long enough, and a kink of 0.1 degrees needs no rounding."""
    radius, count = 50.0, 3141
    angles = np.linspace(0.0, 2.0 * math.pi, count + 1)[1:]
    moves = [
        Feed(n, (radius * math.sin(a), radius * (1 - math.cos(a)), 0.0), 9000.0, Corner("blend", 0.01))
        for n, a in enumerate(angles.tolist())
    ]
    for profile in PROFILES:
        config = build_machine(profile, end_rest_s=0.0)
        reference = plan(moves, config)
        require_limits_kept(reference, config)
        if profile == "trapezoidal":
            assert reference.time_s[-1] == pytest.approx(2 * math.pi * radius / 150.0, rel=0.06)


def test_smoothed_profile_is_unchanged() -> None:
    """``fir`` to the nanometre: digest of a reference that was made before the look-ahead profiles existed.

    Not to the last bit: the order of additions in a convolution depends on the processor.
    """
    reference = plan([*MOVES, Dwell(6, 0.3), *MOVES], bench_config())
    digest = hashlib.sha256()
    for path in reference.position_mm.values():
        digest.update(np.rint(1e6 * path).astype(np.int64).tobytes())
    digest.update(reference.line.tobytes() + reference.rapid.tobytes() + reference.time_s.tobytes())
    assert digest.hexdigest() == "69e5b3e747bad10047bc4251090c0521285cd82a275f8b29d9ce936ef3f870ad"


def test_jerky_demand_is_corrected_as_stream() -> None:
    """Steps of acceleration from a stream of blocks into the streamed correction: as good as the whole at once."""
    config = build_machine("trapezoidal")
    moves = [move for move in MOVES if not isinstance(move, Rapid)]
    models = build_nominal_models(config)
    pieces = (block.position_mm for block in stream_trajectory(moves, config, 100))
    blocks = list(block_streaming.stream_blocks(pieces, models, config))
    assert blocks[-1].final
    assert not any(block.refused for block in blocks)
    before = np.concatenate([block.before_um for block in blocks])
    after = np.concatenate([block.after_um for block in blocks])
    whole = correct(plan(moves, config), models, config, "inverse")
    assert before.size == whole.after.contour_um.size
    assert compute_rms(before) >= 14 * compute_rms(after)
    assert compute_rms(after) == pytest.approx(compute_rms(whole.after.contour_um), rel=0.2, abs=0.05)
