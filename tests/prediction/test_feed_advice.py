"""The feeds that keep a tolerance, verified by prediction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import MachineConfig
from fdhil.correction import plan_correction as plan_correction
from fdhil.correction.result_documents import predict_corrected_contour_um
from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.prediction.feed_advice import FeedAdvice, FeedResult, advise_feeds
from fdhil.prediction.feed_search import (
    RAPID,
    REST,
    FeedScaledPath,
    find_worst_rows,
    label_segments,
    make_program_source,
    scale_feeds,
    search_highest_feeds,
)
from fdhil.program import Dwell, Feed, interpret
from fdhil.program.budget import Budget
from fdhil.records import Float, Parameters, Trajectory, freeze_integers
from tests.bench import bench_config
from tests.paths import build_trajectory

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
# the drives saturate in its corners
SHARP = CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"smoothing_s": (0.030, 0.015)})})
PROGRAM = "G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nG4 P0.1\nM2\n".splitlines()
# two corners of 90 degrees, which are beyond the drives, then one of 37
FAST = "G1 X0 Y40 F20000\nX60\nY80\nX100\nX180 Y140\nX260 Y200\nM2\n".splitlines()


def predict_uncorrected_um(reference: Trajectory) -> Float:
    """Contour error (n,) um."""
    return predict_path(reference, MODELS, SHARP).contour_um


def predict_corrected_um(reference: Trajectory) -> Float:
    """Contour error (n,) um with the correction, which must not be refused."""
    planned = plan_correction(reference, MODELS, SHARP)
    return planned.before.contour_um if planned.refused else planned.after.contour_um


def collect_shares(advice: tuple[FeedAdvice, ...], held: Callable[[FeedAdvice], FeedResult | None]) -> dict[int, float]:
    found = {a.line: held(a) for a in advice}
    return {line: one.share for line, one in found.items() if one is not None and one.share is not None}


@pytest.mark.usefixtures("long_computation")
def test_infeasible_feed_is_reported_with_feasible_feeds() -> None:
    """20 m/min needs 1.7 times the current. Each line has its own feed, also if the correction is refused.

    Together they keep the tolerance, 5 % more do not.
    """
    motions = list(interpret(FAST, Budget.create_from_config(SHARP.nc)))
    source = make_program_source(motions, SHARP)
    advice = advise_feeds(source, MODELS, SHARP, 50.0, lambda r: predict_corrected_contour_um(r, MODELS, SHARP))
    assert [a.line for a in advice] == [1, 2, 3, 4, 5, 6]
    assert all(a.load[1] == "current" and a.load[2] > 1.5 for a in advice[:3])
    assert advice[0].cause == "saturation"
    assert all(a.axis in "XY" for a in advice)
    assert all(a.feed_mm_min == 20000 for a in advice)
    plain, better = collect_shares(advice, lambda a: a.plain), collect_shares(advice, lambda a: a.corrected)
    for shares, judge in ((plain, predict_uncorrected_um), (better, predict_corrected_um)):
        assert len(shares) == len(advice)
        assert judge(source.at(shares)).max() <= 50.0
        assert judge(source.at({line: 1.05 * share for line, share in shares.items()})).max() > 50.0
    assert all(better[line] > 2 * plain[line] for line in (1, 2, 3))
    assert better[5] > 1.1 * better[2]  # the gentle corner is not slowed for the sharp ones


@pytest.mark.parametrize("seed", range(10))
def test_advised_feeds_keep_tolerance_and_higher_do_not(seed: int) -> None:
    """For any program, drives, smoothing and tolerance: all advised feeds together keep it, 5 % more do not."""
    random = np.random.default_rng(1000 + seed)
    config = bench_config(str(random.choice(["XY", "XYZ"])))
    smoothing = ((0.060, 0.030), (0.040,))[seed % 2]
    config = config.model_copy(update={"nc": config.nc.model_copy(update={"smoothing_s": smoothing})})
    models = {
        axis: replace(model, Jt=model.Jt * random.uniform(0.9, 1.2), Cd=model.Cd * random.uniform(0.2, 1.0))
        for axis, model in build_nominal_models(config).items()
    }
    source = make_program_source(
        list(interpret(draw_program(random, config), Budget.create_from_config(config.nc))), config
    )
    tolerance = float(predict_path(source.at({}), models, config).contour_um.max() * random.uniform(0.25, 0.8))
    advice = advise_feeds(source, models, config, tolerance)
    shares = collect_shares(advice, lambda a: a.plain)
    assert len(shares) == len(advice) > 0
    assert find_largest_error(source, shares, models, config) <= tolerance
    assert (
        find_largest_error(source, {line: 1.05 * share for line, share in shares.items()}, models, config) > tolerance
    )


def test_no_single_line_could_run_much_faster() -> None:
    lines = ["G21 G90 G64 F12000", "G1 X40", "Y12", "X70 Y45", "G3 X90 Y25 I20", "G1 X90 Y-20", "M2"]
    source = make_program_source(list(interpret(lines, Budget.create_from_config(CONFIG.nc))), CONFIG)
    shares = collect_shares(advise_feeds(source, MODELS, CONFIG, 35.0), lambda a: a.plain)
    assert find_largest_error(source, shares, MODELS, CONFIG) <= 35.0
    slowed = [line for line, share in shares.items() if share < 0.95]
    assert len(slowed) >= 4
    for line in slowed:
        assert find_largest_error(source, {**shares, line: 1.1 * shares[line]}, MODELS, CONFIG) > 35.0


def test_worst_rows_of_recurring_segments() -> None:
    """Line 1 twice, line 2 between: each with the largest error in it and behind it, a rapid not assessed."""
    stretch = np.array([1, 1, 2, 2, 1, RAPID, 3, REST])
    error = np.array([1.0, 2.0, 7.0, 1.0, 3.0, 99.0, 4.0, 5.0])
    assert find_worst_rows(stretch, error, 0.001, 0.001) == {1: (7.0, 2), 2: (7.0, 2), 3: (5.0, 7)}
    assert find_worst_rows(stretch, error, 0.001, 0.0) == {1: (3.0, 4), 2: (7.0, 2), 3: (4.0, 6)}


def find_largest_error(
    source: FeedScaledPath, shares: Mapping[int, float], models: Mapping[str, Parameters], config: MachineConfig
) -> float:
    return float(predict_path(source.at(shares), models, config).contour_um.max())


def draw_program(random: np.random.Generator, config: MachineConfig) -> list[str]:
    lines = [f"G21 G90 G64 F{random.uniform(3000, 15000):.0f}"]
    at = np.zeros(2)
    for _ in range(random.integers(2, 7)):
        angle = random.choice([0.0, np.pi / 2, random.uniform(0, 2 * np.pi)])
        if random.random() < 0.75:
            at = at + random.uniform(3, 60) * np.array([np.cos(angle), np.sin(angle)])
            rise = f" Z{random.uniform(-20, 20):.3f}" if "Z" in config.axis else ""
            lines.append(f"G1 X{at[0]:.3f} Y{at[1]:.3f}{rise}")
        else:
            centre = at + random.uniform(3, 30) * np.array([np.cos(angle), np.sin(angle)])
            turn = random.uniform(0.5, 3)
            spoke = at - centre
            end = centre + np.array(
                [spoke[0] * np.cos(turn) - spoke[1] * np.sin(turn), spoke[0] * np.sin(turn) + spoke[1] * np.cos(turn)]
            )
            lines.append("G3 X{:.4f} Y{:.4f} I{:.4f} J{:.4f}".format(*end, *(centre - at)))
            at = end
    return [*lines, "M2"]


def test_corner_error_belongs_to_line_before() -> None:
    source = make_program_source(list(interpret(PROGRAM, Budget.create_from_config(CONFIG.nc))), CONFIG)
    advice = advise_feeds(source, MODELS, CONFIG, 60.0)
    assert [a.line for a in advice] == [2, 3]
    assert all(a.corrected is None and a.load[2] < 1.0 for a in advice)
    assert find_largest_error(source, collect_shares(advice, lambda a: a.plain), MODELS, CONFIG) <= 60.0


def test_path_within_tolerance_gets_no_advice() -> None:
    source = make_program_source(list(interpret(PROGRAM, Budget.create_from_config(CONFIG.nc))), CONFIG)
    assert advise_feeds(source, MODELS, CONFIG, 250.0) == ()


@pytest.mark.usefixtures("real_time")
def test_tight_tolerance_is_kept_at_one_percent_feed() -> None:
    """Dry friction leaves 10 um of a corner down to a few hundredths of 15 m/min; no feed keeps a twentieth of them."""
    source = make_program_source(list(interpret(PROGRAM[:3], Budget.create_from_config(CONFIG.nc))), CONFIG)
    shares = collect_shares(advise_feeds(source, MODELS, CONFIG, 10.0), lambda a: a.plain)
    assert 0.005 < shares[3] < 0.05
    assert find_largest_error(source, shares, MODELS, CONFIG) <= 10.0
    for advice in advise_feeds(source, MODELS, CONFIG, 0.5):
        assert advice.plain.share is None
        assert advice.plain.residual_um > 0.5
        assert advice.plain.tried < 0.1


def test_rapids_are_excluded_and_rests_included() -> None:
    program = "G0 X20\nG1 Y30 F15000\nM2".splitlines()
    source = make_program_source(list(interpret(program, Budget.create_from_config(CONFIG.nc))), CONFIG)
    assert set(label_segments(source.at({})).tolist()) == {RAPID, REST, 2}


def test_only_feed_moves_are_scaled() -> None:
    motions = list(interpret(PROGRAM, Budget.create_from_config(CONFIG.nc)))
    halved = scale_feeds(motions, lambda _: 0.5)
    assert [m.feed for m in halved if isinstance(m, Feed)] == [7500.0, 7500.0]
    assert [m for m in halved if isinstance(m, Dwell)] == [m for m in motions if isinstance(m, Dwell)]


def make_source(
    errors: Callable[[Mapping[int, float]], list[float]],
) -> tuple[FeedScaledPath, Callable[[Trajectory], Float]]:
    """Return segments 1, 2 .. of one row each whose errors depend on the shares as given."""
    asked: list[Mapping[int, float]] = []

    def generate(shares: Mapping[int, float]) -> Trajectory:
        asked.append(shares)
        n = len(errors(shares))
        return replace(build_trajectory(np.zeros((n, 1)), "X"), line=freeze_integers(1 + np.arange(n)))

    source = FeedScaledPath(generate, line=lambda k: k, feed_mm_min=lambda _: 1000.0, after_s=0.0)
    return source, lambda _: np.array(errors(asked[-1]))


@pytest.mark.parametrize("power", [0.3, 1.0, 2.0])
def test_power_law_error_is_solved(power: float) -> None:
    """The share is the one at which the error equals the tolerance, to 5 %."""
    source, judge = make_source(
        lambda shares: [40.0 * shares.get(1, 1.0) ** power, 100.0 * shares.get(2, 1.0) ** power]
    )
    found = search_highest_feeds(source, {1: 40.0, 2: 100.0}, judge, 20.0)
    for k, error in ((1, 40.0), (2, 100.0)):
        exact = (20.0 / error) ** (1 / power)
        assert 0.95 * exact < found.share[k] <= exact


def test_slowed_neighbour_allows_higher_feed() -> None:
    """Segment 2 causes the error of segment 1: with that slowed, segment 1 may run nearly as programmed."""
    source, judge = make_source(lambda s: [15.0 * s.get(1, 1.0) + 30.0 * s.get(2, 1.0) ** 2, 80.0 * s.get(2, 1.0)])
    found = search_highest_feeds(source, {1: 45.0, 2: 80.0}, judge, 20.0)
    assert found.within_tolerance == {1, 2}
    assert found.share[2] > 0.24
    assert found.share[1] > 0.95


def test_segment_affected_by_neighbour_joins_search() -> None:
    source, judge = make_source(lambda s: [40.0 * s.get(1, 1.0), 30.0 * s.get(2, 1.0) - 15.0 * s.get(1, 1.0)])
    found = search_highest_feeds(source, {1: 40.0}, judge, 20.0)
    assert found.within_tolerance == {1, 2}
    assert 40.0 * found.share[1] <= 20.0
    assert 30.0 * found.share[2] - 15.0 * found.share[1] <= 20.0


def test_segment_with_unknown_error_is_not_slowed() -> None:
    def compute_errors(shares: Mapping[int, float]) -> list[float]:
        beyond = shares.get(1, 1.0) > 0.4
        return [np.inf if beyond else 10.0, np.nan if beyond else 19.0]

    source, judge = make_source(compute_errors)
    found = search_highest_feeds(source, {1: 50.0, 2: 30.0}, judge, 20.0)
    assert found.share[2] == 1.0
    assert 0.38 < found.share[1] <= 0.4
    assert found.within_tolerance == {1, 2}


def test_acceleration_error_falls_only_at_low_feed() -> None:
    source, judge = make_source(lambda shares: [50.0 * min(1.0, shares.get(1, 1.0) / 0.2), 40.0 * shares.get(2, 1.0)])
    found = search_highest_feeds(source, {1: 50.0, 2: 40.0}, judge, 20.0)
    assert found.within_tolerance == {1, 2}
    assert 0.95 * 0.08 < found.share[1] <= 0.08


def test_feed_independent_error_is_given_up_early() -> None:
    trials: list[int] = []

    def compute_errors(shares: Mapping[int, float]) -> list[float]:
        trials.append(1)
        return [50.0, 40.0 * shares.get(2, 1.0)]

    source, judge = make_source(compute_errors)
    found = search_highest_feeds(source, {1: 50.0, 2: 40.0}, judge, 20.0)
    assert found.within_tolerance == {2}
    assert found.residual_um[1] == 50.0
    assert len(trials) < 40
