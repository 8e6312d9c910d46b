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
from fdhil.program.motions import BLEND, ORIGIN, Corner, Place, reached
from fdhil.program.planner import stream
from fdhil.program.planner.limits import AxisLimits
from fdhil.program.planner.pieces import LENGTH, piece, points
from fdhil.records import Float, Trajectory
from tests.bench import bench_config, bench_document
from tests.paths import compute_rms
from tests.program.test_planner import MOVES, check_blocks

DT_S = 1e-3
PROFILES = ("trapezoidal", "jerk_limited")
EXACT_PATH, EXACT_STOP = Corner("exact_path", 0.0), Corner("exact_stop", 0.0)


def machine(profile: str, axes: str = "XY", **keys: object) -> MachineConfig:
    document = bench_document(axes)
    document["nc"] = {"profile": profile, **keys}
    document["axis"]["Y"]["max_acceleration_mm_s2"] = 2500.0  # so that the axes differ
    document["axis"]["X"]["max_jerk_mm_s3"] = 150_000.0
    return parse_config(document)


def cornered(moves: Sequence[Motion], corner: Corner) -> list[Motion]:
    return [move if isinstance(move, Dwell) else replace(move, corner=corner) for move in moves]


def random_moves(seed: int, count: int = 12) -> list[Motion]:
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


def dense_path(moves: Sequence[Motion], config: MachineConfig) -> Float:
    at: Place = ORIGIN
    parts = []
    for move in moves:
        assert not isinstance(move, Dwell)
        row = np.array(piece(move, at, AxisLimits.of(config)))
        share = np.linspace(0.0, row[LENGTH], 10001)
        parts.append(points(np.repeat(row[None], share.size, axis=0), share))
        at = reached(move, at)
    return np.concatenate(parts)[:, :2]


def columns(reference: Trajectory) -> Float:
    return np.column_stack([reference.position_mm[axis] for axis in reference.axes])


def check_limits(reference: Trajectory, config: MachineConfig) -> None:
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
def test_every_axis_keeps_its_limits(profile: str, corner: Corner) -> None:
    config = machine(profile)
    for moves in (MOVES, *(random_moves(seed) for seed in range(8))):
        reference = plan(cornered(moves, corner), config)
        check_limits(reference, config)
        last = moves[-1]
        assert not isinstance(last, Dwell)
        np.testing.assert_allclose(columns(reference)[-1], last.end[:2], atol=1e-9)


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("tolerance_mm", [0.0, 0.01, 0.1])
def test_the_path_is_left_by_no_more_than_p(profile: str, tolerance_mm: float) -> None:
    config = machine(profile)
    furthest = 0.0
    for seed in range(8):
        moves = random_moves(seed)
        corner = Corner("blend", tolerance_mm) if tolerance_mm else EXACT_PATH
        reference = columns(plan(cornered(moves, corner), config))
        furthest = max(furthest, float(np.max(cKDTree(dense_path(moves, config)).query(reference)[0])))
    sampling_mm = 0.003  # finest resolution of an arc of 50 mm
    assert furthest <= tolerance_mm + sampling_mm
    assert furthest >= 0.6 * tolerance_mm


@pytest.mark.parametrize("profile", PROFILES)
def test_a_wider_tolerance_is_faster(profile: str) -> None:
    config = machine(profile)
    moves = [move for move in MOVES if not isinstance(move, Rapid)]
    corners = (EXACT_STOP, Corner("blend", 0.02), Corner("blend", 0.2), BLEND)
    times = [float(plan(cornered(moves, corner), config).time_s[-1]) for corner in corners]
    assert times[1:] == sorted(times[1:], reverse=True)
    assert times[0] - times[-1] > 0.08


def test_a_trapezoid_takes_its_time() -> None:
    document = bench_document()
    document["nc"] = {"profile": "trapezoidal", "end_rest_s": 0.0}
    reference = plan([Feed(3, (100.0, 0.0, 0.0), 6000.0)], parse_config(document))
    assert reference.time_s[-1] == pytest.approx(100.0 / 100.0 + 100.0 / 4000.0, abs=2e-3)
    t = reference.time_s
    np.testing.assert_allclose(reference.position_mm["X"][:26], 2000.0 * t[:26] ** 2, atol=1e-9)
    assert reference.line[0] == 0
    assert set(reference.line[1:]) == {3}


def test_a_jerk_limited_ramp_is_s_shaped() -> None:
    config = machine("jerk_limited")
    reference = plan([Feed(1, (100.0, 0.0, 0.0), 6000.0)], config)
    acceleration = np.diff(reference.position_mm["X"], 2) / DT_S**2
    steps = np.abs(np.diff(acceleration))
    assert steps.max() <= 150_000.0 * DT_S * (1 + 1e-6)
    assert acceleration.max() > 1000.0


def test_g61_1_rests_at_the_corner_and_g61_does_not_leave_it() -> None:
    config = machine("trapezoidal", settle_s=0.02)
    corner = np.array([0.0, 55.0])
    for mode, rows in ((EXACT_STOP, 20), (EXACT_PATH, 1)):
        reference = columns(plan(cornered(MOVES[:2], mode), config))
        distance = np.linalg.norm(reference - corner, axis=1)
        assert distance.min() < 5e-3
        assert np.count_nonzero(distance < 1e-9) >= rows - 1
    blended = columns(plan(cornered(MOVES[:2], Corner("blend", 0.1)), config))
    assert 0.05 < np.linalg.norm(blended - corner, axis=1).min() <= 0.1 * 1.02


def test_the_configuration_may_ask_for_stops_everywhere() -> None:
    reference = plan(MOVES[:2], machine("trapezoidal", corner="exact_stop", settle_s=0.01))
    assert np.count_nonzero(np.linalg.norm(columns(reference) - [0.0, 55.0], axis=1) < 1e-9) >= 10


def test_rapid_and_feed_are_parted_by_a_stop_unless_the_configuration_blends_them() -> None:
    moves: list[Motion] = [Rapid(1, (50.0, 0.0, 0.0)), Feed(2, (50.0, 50.0, 0.0), 6000.0)]
    nearest = []
    for stop in (True, False):
        reference = columns(plan(moves, machine("trapezoidal", rapid_stop=stop)))
        nearest.append(float(np.linalg.norm(reference - [50.0, 0.0], axis=1).min()))
    assert nearest[0] < 1e-9
    assert nearest[1] > 0.1


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("profile", PROFILES)
def test_blocks_make_the_same_reference_whatever_their_length(profile: str) -> None:
    config = machine(profile)
    moves = [*random_moves(3, 700), Dwell(701, 0.25), *MOVES]
    check_blocks(moves, config)
    check_limits(plan(moves, config), config)


def zigzag(count: int) -> Iterator[Motion]:
    for number in range(count):
        yield Feed(number, (0.3 * (number % 2), 0.2 * (number % 2), 0.0), 3000.0, Corner("blend", 0.01))


@pytest.mark.usefixtures("long_computation")
def test_a_long_program_is_planned_in_flat_memory() -> None:
    config = machine("jerk_limited")
    peaks = []
    for count in (3000, 9000):
        tracemalloc.start()
        for _ in stream(zigzag(count), config, 1000):
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
        config = machine(profile, end_rest_s=0.0)
        reference = plan(moves, config)
        check_limits(reference, config)
        if profile == "trapezoidal":
            assert reference.time_s[-1] == pytest.approx(2 * math.pi * radius / 150.0, rel=0.06)


def test_the_smoothed_profile_is_what_it_was() -> None:
    """``fir`` to the nanometre: digest of a reference that was made before the look-ahead profiles existed.

    Not to the last bit: the order of additions in a convolution depends on the processor.
    """
    reference = plan([*MOVES, Dwell(6, 0.3), *MOVES], bench_config())
    digest = hashlib.sha256()
    for path in reference.position_mm.values():
        digest.update(np.rint(1e6 * path).astype(np.int64).tobytes())
    digest.update(reference.line.tobytes() + reference.rapid.tobytes() + reference.time_s.tobytes())
    assert digest.hexdigest() == "69e5b3e747bad10047bc4251090c0521285cd82a275f8b29d9ce936ef3f870ad"


def test_a_jerky_demand_is_corrected_while_it_is_planned() -> None:
    """Steps of acceleration from a stream of blocks into the streamed correction: as good as the whole at once."""
    config = machine("trapezoidal")
    moves = [move for move in MOVES if not isinstance(move, Rapid)]
    models = build_nominal_models(config)
    pieces = (block.position_mm for block in stream(moves, config, 100))
    blocks = list(block_streaming.stream_blocks(pieces, models, config))
    assert blocks[-1].final
    assert not any(block.refused for block in blocks)
    before = np.concatenate([block.before_um for block in blocks])
    after = np.concatenate([block.after_um for block in blocks])
    whole = correct(plan(moves, config), models, config, "inverse")
    assert before.size == whole.after.contour_um.size
    assert compute_rms(before) >= 14 * compute_rms(after)
    assert compute_rms(after) == pytest.approx(compute_rms(whole.after.contour_um), rel=0.2, abs=0.05)
