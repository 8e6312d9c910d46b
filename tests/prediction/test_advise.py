"""The feed that keeps a tolerance."""

from __future__ import annotations

import pytest

from fdhil.prediction import predict
from fdhil.prediction.advise import _highest, advise, at_share, demand_at, program_at
from fdhil.prediction.models import nominal_models
from fdhil.program import Dwell, Feed, interpret
from fdhil.program import plan as plan_program
from fdhil.program.budget import Budget
from tests.bench import bench_config
from tests.paths import bench_trajectory

CONFIG = bench_config()
MODELS = nominal_models(CONFIG)
PROGRAM = "G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nG4 P0.1\nM2\n".splitlines()


def test_the_advised_feed_keeps_the_tolerance() -> None:
    """Run at the lowest of the advised feeds, the whole program is within the tolerance."""
    motions = list(interpret(PROGRAM, Budget.of(CONFIG.nc)))
    advice = advise(program_at(motions, CONFIG), MODELS, CONFIG, 40.0)
    assert [a.line for a in advice] == [3]
    shares = [a.share for a in advice if a.share is not None]
    assert len(shares) == 1
    slowed = plan_program(at_share(motions, min(shares)), CONFIG)
    assert predict(slowed, MODELS, CONFIG).contour_um.max() < 44.0
    assert predict(program_at(motions, CONFIG)(1.0), MODELS, CONFIG).contour_um.max() > 100.0


def test_a_path_within_the_tolerance_needs_no_advice() -> None:
    """Nothing is listed."""
    assert advise(demand_at(bench_trajectory(10)), MODELS, CONFIG, 150.0) == ()


def test_a_demand_is_judged_as_a_whole() -> None:
    """A recorded demand has no lines: one advice, numbered 0."""
    (advice,) = advise(demand_at(bench_trajectory(10)), MODELS, CONFIG, 50.0)
    assert advice.line == 0
    assert advice.share is not None
    assert 0.3 < advice.share < 0.7


def test_only_feeds_are_scaled() -> None:
    """Dwells and rapids stay."""
    motions = list(interpret(PROGRAM, Budget.of(CONFIG.nc)))
    halved = at_share(motions, 0.5)
    assert [m.feed for m in halved if isinstance(m, Feed)] == [7500.0, 7500.0]
    assert [m for m in halved if isinstance(m, Dwell)] == [m for m in motions if isinstance(m, Dwell)]


@pytest.mark.parametrize(
    ("errors", "share"),
    [([10, 5], 1.0), ([30, 10], 0.75), ([30, 30], None), ([30, 10, 30], None), ([30, 40, 20], 0.25), ([], None)],
)
def test_between_two_shares_the_feed_is_interpolated(errors: list[float], share: float | None) -> None:
    """The highest share below which nothing leaves the tolerance of 20."""
    assert _highest([1.0, 0.5, 0.25], errors, 20.0) == share
