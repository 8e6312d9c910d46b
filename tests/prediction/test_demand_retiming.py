"""A recorded demand at other feeds, against what the NC's planner makes of the program at those feeds."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fdhil.config import MachineConfig
from fdhil.prediction import predict_path
from fdhil.prediction.axis_models import build_nominal_models
from fdhil.prediction.demand_retiming import SmoothingFilters, label_segments_around, make_demand_sources
from fdhil.prediction.feed_advice import advise_feeds
from fdhil.prediction.feed_search import make_program_source
from fdhil.program import interpret
from fdhil.program.budget import Budget
from fdhil.records import Float, Trajectory, freeze_array
from tests.bench import bench_config
from tests.paths import build_bench_trajectory, build_jerky_demand, build_trajectory

CONFIG = bench_config()
MODELS = build_nominal_models(CONFIG)
PROGRAM = "G1 X0 Y55 F10000\nX100\nG3 X200 Y55 I50 J0\nG1 X250 Y55\nX250 Y0\nM2\n".splitlines()


def round_demand(reference: Trajectory, decimals: int) -> Trajectory:
    return replace(
        reference, position_mm={a: freeze_array(np.round(path, decimals)) for a, path in reference.position_mm.items()}
    )


def find_largest_error(reference: Trajectory) -> float:
    return float(predict_path(reference, MODELS, CONFIG).contour_um.max())


@pytest.mark.parametrize("share", [0.7, 0.3])
@pytest.mark.parametrize(("decimals", "within_um"), [(9, 0.3), (6, 0.3)])
def test_slower_demand_equals_nc_output(share: float, decimals: int, within_um: float) -> None:
    """With the averages removed and applied again (9 decimals), or each move scaled (6): the program's own errors.

    Stretched time would predict half of them.
    """
    program = make_program_source(list(interpret(PROGRAM, Budget.create_from_config(CONFIG.nc))), CONFIG)
    truth = find_largest_error(program.at(dict.fromkeys(range(1, 6), share)))
    sure, hopeful = make_demand_sources(round_demand(program.at({}), decimals), MODELS, CONFIG, 1e6)
    assert (hopeful is None) == (decimals == 9)
    assert find_largest_error(sure.at({1: share})) == pytest.approx(truth, abs=within_um)
    if hopeful is not None:
        assert find_largest_error(hopeful.at({1: share})) < 0.85 * truth


def test_configured_smoothing_is_recognised_and_other_rejected() -> None:
    averages = SmoothingFilters((0.060, 0.030), 0.001)
    path = np.column_stack([build_bench_trajectory(10).position_mm[axis] for axis in "XY"])
    under = averages.remove_smoothing(path)
    assert under is not None
    speeds = np.linalg.norm(np.diff(under, axis=0), axis=1)
    assert speeds.max() == pytest.approx(10 / 60, rel=0.01)  # m/min in mm per ms, without ramps
    assert SmoothingFilters((0.050, 0.030), 0.001).remove_smoothing(path) is None
    assert averages.remove_smoothing(build_jerky_demand(10)) is None
    assert averages.remove_smoothing(np.zeros((300, 2))) is not None


@pytest.mark.parametrize("profile", ["fir", "trapezoidal"])
def test_recorded_feed_returns_demand(profile: str) -> None:
    config = CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"profile": profile})})
    for reference in (build_bench_trajectory(10), build_trajectory(build_jerky_demand(10))):
        for source in filter(None, make_demand_sources(reference, MODELS, config, 30.0)):
            again = source.at({1: 1.0 - 1e-12})  # so that the rules are at work
            path = again.position_mm["X"][: reference.time_s.size]
            assert np.abs(path - reference.position_mm["X"][: path.size]).max() < 1e-3


def test_rules_scale_speed_and_acceleration_differently() -> None:
    path = np.asarray(build_jerky_demand(10)[:300, 1:])
    averages, stretch, share = SmoothingFilters((), 0.001), np.ones(len(path), dtype=np.int64), np.full(len(path), 0.5)

    def compute_acceleration(moved: Float) -> float:
        return float(np.abs(np.diff(moved[:, 0], 2)).max())

    whole = compute_acceleration(path)
    for rule, left in ((averages.limit_speed, 1.0), (averages.scale_distances, 0.5), (averages.stretch_time, 0.25)):
        moved, _ = rule(path, stretch, share)
        assert compute_acceleration(moved) == pytest.approx(left * whole, rel=0.1)
        reached = path[-1, 0] * (0.5 if rule == averages.scale_distances else 1.0)
        assert moved[-1, 0] == pytest.approx(reached, abs=0.1)


@pytest.mark.parametrize(
    "config", [CONFIG, CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"profile": "trapezoidal"})})]
)
def test_each_demand_zone_gets_own_feed(config: MachineConfig) -> None:
    """Zones in the order of time, each with its own feed; together they keep the tolerance, 5 % more do not."""
    reference = build_trajectory(build_jerky_demand(10))
    sure, hopeful = make_demand_sources(reference, MODELS, config, 20.0)
    assert hopeful is not None
    advice = advise_feeds(sure, MODELS, config, 20.0)
    assert [a.line for a in advice] == [0] * len(advice)
    assert len(advice) >= 3
    assert all(a.start_s < b.start_s for a, b in pairwise(advice))
    shares = {k: a.plain.share for k, a in enumerate(advice, 1) if a.plain.share}
    if config.nc.profile == "fir":
        assert max(shares.values()) > 1.05 * min(shares.values())
        assert len(shares) == len(advice)
        assert predict_path(sure.at(shares), MODELS, config).contour_um.max() <= 20.0
        faster = {k: 1.05 * share for k, share in shares.items()}
        assert predict_path(sure.at(faster), MODELS, config).contour_um.max() > 20.0
    else:  # a corner that is blended at the limit of acceleration is not the gentler for a lower feed
        lost = [a.plain for a in advice if a.plain.share is None]
        assert lost
        assert all(held.residual_um > 20.0 for held in lost)
    most = advise_feeds(hopeful, MODELS, config, 20.0)
    assert all((b.plain.share or 0.0) >= 0.98 * (a.plain.share or 0.0) for a, b in zip(advice, most, strict=True))


def test_segments_meet_halfway_between_errors() -> None:
    over = np.zeros(20, dtype=np.bool_)
    over[[2, 3, 5, 14]] = True
    assert label_segments_around(over, 4).tolist() == [1] * 9 + [2] * 11
    assert set(label_segments_around(np.zeros(5, dtype=np.bool_), 4).tolist()) == {1}
