"""A recorded demand at other feeds, against what the NC's planner makes of the program at those feeds."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fdhil.config import MachineConfig
from fdhil.prediction import predict
from fdhil.prediction.advise import advise
from fdhil.prediction.feed_search import program_source
from fdhil.prediction.models import nominal_models
from fdhil.prediction.retime import Averages, demand_sources, stretches_around
from fdhil.program import interpret
from fdhil.program.budget import Budget
from fdhil.records import Float, Trajectory, freeze_array
from tests.bench import bench_config
from tests.paths import build_bench_trajectory, build_jerky_demand, build_trajectory

CONFIG = bench_config()
MODELS = nominal_models(CONFIG)
PROGRAM = "G1 X0 Y55 F10000\nX100\nG3 X200 Y55 I50 J0\nG1 X250 Y55\nX250 Y0\nM2\n".splitlines()


def rounded(reference: Trajectory, decimals: int) -> Trajectory:
    return replace(
        reference, position_mm={a: freeze_array(np.round(path, decimals)) for a, path in reference.position_mm.items()}
    )


def largest(reference: Trajectory) -> float:
    return float(predict(reference, MODELS, CONFIG).contour_um.max())


@pytest.mark.parametrize("share", [0.7, 0.3])
@pytest.mark.parametrize(("decimals", "within_um"), [(9, 0.3), (6, 0.3)])
def test_a_slower_demand_is_what_the_nc_would_order(share: float, decimals: int, within_um: float) -> None:
    """With the averages removed and applied again (9 decimals), or each move scaled (6): the program's own errors.

    Stretched time would predict half of them.
    """
    program = program_source(list(interpret(PROGRAM, Budget.of(CONFIG.nc))), CONFIG)
    truth = largest(program.at(dict.fromkeys(range(1, 6), share)))
    sure, hopeful = demand_sources(rounded(program.at({}), decimals), MODELS, CONFIG, 1e6)
    assert (hopeful is None) == (decimals == 9)
    assert largest(sure.at({1: share})) == pytest.approx(truth, abs=within_um)
    if hopeful is not None:
        assert largest(hopeful.at({1: share})) < 0.85 * truth


def test_the_averages_are_known_again_and_others_are_not() -> None:
    averages = Averages((0.060, 0.030), 0.001)
    path = np.column_stack([build_bench_trajectory(10).position_mm[axis] for axis in "XY"])
    under = averages.taken_off(path)
    assert under is not None
    speeds = np.linalg.norm(np.diff(under, axis=0), axis=1)
    assert speeds.max() == pytest.approx(10 / 60, rel=0.01)  # m/min in mm per ms, without ramps
    assert Averages((0.050, 0.030), 0.001).taken_off(path) is None
    assert averages.taken_off(build_jerky_demand(10)) is None
    assert averages.taken_off(np.zeros((300, 2))) is not None


@pytest.mark.parametrize("profile", ["fir", "trapezoidal"])
def test_at_the_feed_as_recorded_it_is_the_demand(profile: str) -> None:
    config = CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"profile": profile})})
    for reference in (build_bench_trajectory(10), build_trajectory(build_jerky_demand(10))):
        for source in filter(None, demand_sources(reference, MODELS, config, 30.0)):
            again = source.at({1: 1.0 - 1e-12})  # so that the rules are at work
            path = again.position_mm["X"][: reference.time_s.size]
            assert np.abs(path - reference.position_mm["X"][: path.size]).max() < 1e-3


def test_rules_differ_in_what_falls_with_the_feed() -> None:
    path = np.asarray(build_jerky_demand(10)[:300, 1:])
    averages, stretch, share = Averages((), 0.001), np.ones(len(path), dtype=np.int64), np.full(len(path), 0.5)

    def acceleration(moved: Float) -> float:
        return float(np.abs(np.diff(moved[:, 0], 2)).max())

    whole = acceleration(path)
    for rule, left in ((averages.capped, 1.0), (averages.scaled, 0.5), (averages.stretched, 0.25)):
        moved, _ = rule(path, stretch, share)
        assert acceleration(moved) == pytest.approx(left * whole, rel=0.1)
        reached = path[-1, 0] * (0.5 if rule == averages.scaled else 1.0)
        assert moved[-1, 0] == pytest.approx(reached, abs=0.1)


@pytest.mark.parametrize(
    "config", [CONFIG, CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"profile": "trapezoidal"})})]
)
def test_each_zone_of_a_demand_has_its_feed(config: MachineConfig) -> None:
    """Zones in the order of time, each with its own feed; together they keep the tolerance, 5 % more do not."""
    reference = build_trajectory(build_jerky_demand(10))
    sure, hopeful = demand_sources(reference, MODELS, config, 20.0)
    assert hopeful is not None
    advice = advise(sure, MODELS, config, 20.0)
    assert [a.line for a in advice] == [0] * len(advice)
    assert len(advice) >= 3
    assert all(a.start_s < b.start_s for a, b in pairwise(advice))
    shares = {k: a.plain.share for k, a in enumerate(advice, 1) if a.plain.share}
    if config.nc.profile == "fir":
        assert max(shares.values()) > 1.05 * min(shares.values())
        assert len(shares) == len(advice)
        assert predict(sure.at(shares), MODELS, config).contour_um.max() <= 20.0
        faster = {k: 1.05 * share for k, share in shares.items()}
        assert predict(sure.at(faster), MODELS, config).contour_um.max() > 20.0
    else:  # a corner that is blended at the limit of acceleration is not the gentler for a lower feed
        lost = [a.plain for a in advice if a.plain.share is None]
        assert lost
        assert all(held.left_um > 20.0 for held in lost)
    most = advise(hopeful, MODELS, config, 20.0)
    assert all((b.plain.share or 0.0) >= 0.98 * (a.plain.share or 0.0) for a, b in zip(advice, most, strict=True))


def test_stretches_meet_half_way_between_errors() -> None:
    over = np.zeros(20, dtype=np.bool_)
    over[[2, 3, 5, 14]] = True
    assert stretches_around(over, 4).tolist() == [1] * 9 + [2] * 11
    assert set(stretches_around(np.zeros(5, dtype=np.bool_), 4).tolist()) == {1}
