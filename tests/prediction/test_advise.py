"""The feeds that keep a tolerance, checked by running them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest

from fdhil.correction import plan as plan_correction
from fdhil.prediction import advise as advising
from fdhil.prediction import predict
from fdhil.prediction.advise import REST, Advice, advise, at_shares, demand_source, program_source
from fdhil.prediction.models import nominal_models
from fdhil.program import Dwell, Feed, interpret
from fdhil.program import plan as plan_program
from fdhil.program.budget import Budget
from fdhil.records import Float, Trajectory
from tests.bench import bench_config
from tests.paths import bench_trajectory

CONFIG = bench_config()
MODELS = nominal_models(CONFIG)
# the drives saturate in its corners
SHARP = CONFIG.model_copy(update={"nc": CONFIG.nc.model_copy(update={"smoothing_s": (0.030, 0.015)})})
PROGRAM = "G21 G90 G64\nG1 X0 Y30 F15000\nG1 X40\nG4 P0.1\nM2\n".splitlines()
FAST = "G1 X0 Y55 F20000\nX100\nG3 X200 Y55 I50 J0\nG1 X250 Y55\nX250 Y0\nM2\n".splitlines()


def uncorrected(reference: Trajectory) -> Float:
    """Contour error (n,) um."""
    return predict(reference, MODELS, SHARP).contour_um


def corrected(reference: Trajectory) -> Float:
    """Contour error (n,) um with the correction."""
    return plan_correction(reference, MODELS, SHARP).after.contour_um


def test_a_beyond_the_drives_feed_is_told_with_the_feeds_that_hold() -> None:
    """20 m/min asks for 1.7 times the current: every line is named; its feeds keep the tolerance, 10 % more do not."""
    motions = list(interpret(FAST, Budget.of(SHARP.nc)))
    advice = advise(program_source(motions, SHARP), MODELS, SHARP, 50.0, corrected)
    assert [a.line for a in advice] == [1, 2, 3, 4, 5]
    assert all(a.demand is not None and a.demand[1] == "current" and a.demand[2] > 1.5 for a in advice)
    assert {a.cause for a in advice} == {"saturation"}
    assert all(a.feed_mm_min == 20000 for a in advice)
    cases: list[tuple[Callable[[Advice], float | None], Callable[[Trajectory], Float]]] = [
        (lambda a: a.share, uncorrected),
        (lambda a: a.corrected_share, corrected),
    ]
    for share, judge in cases:
        shares = {a.line: float(share(a) or 0.0) for a in advice}
        assert judge(plan_program(at_shares(motions, shares.__getitem__), SHARP)).max() <= 50.0
        faster: Mapping[int, float] = {line: 1.1 * value for line, value in shares.items()}
        assert judge(plan_program(at_shares(motions, faster.__getitem__), SHARP)).max() > 50.0
    assert min(a.corrected_share or 0.0 for a in advice) > 4 * max(a.share or 0.0 for a in advice)


def test_the_line_before_a_corner_answers_for_it() -> None:
    """The corner's error shows in the line behind it, and comes from both."""
    motions = list(interpret(PROGRAM, Budget.of(CONFIG.nc)))
    source = program_source(motions, CONFIG)
    advice = advise(source, MODELS, CONFIG, 60.0)
    assert [a.line for a in advice] == [2, 3]
    assert all(a.corrected_share is None and a.demand is None for a in advice)
    at_two = source.mixed and source.mixed({a.line: a.share or 0.0 for a in advice})
    assert at_two is not None
    assert predict(at_two, MODELS, CONFIG).contour_um.max() <= 60.0


def test_a_path_within_the_tolerance_needs_no_advice() -> None:
    """Nothing is listed."""
    assert advise(demand_source(bench_trajectory(10)), MODELS, CONFIG, 150.0) == ()


def test_a_demand_is_played_slower_and_told_by_zones() -> None:
    """A recorded demand has no lines: its corners are listed, each with the share that keeps it within."""
    reference = bench_trajectory(10)
    advice = advise(demand_source(reference), MODELS, CONFIG, 50.0)
    assert [a.line for a in advice] == [0] * len(advice)
    assert len(advice) == 4
    assert {a.cause for a in advice} == {"corner"}
    share = min(a.share or 0.0 for a in advice)
    assert 0.4 < share < 0.95
    assert predict(demand_source(reference).at(share), MODELS, CONFIG).contour_um.max() <= 50.0
    assert predict(demand_source(reference).at(1.1 * share), MODELS, CONFIG).contour_um.max() > 50.0


def test_a_slower_demand_runs_the_same_path() -> None:
    """Half the speed takes twice the time and ends where it ended."""
    reference = bench_trajectory(10)
    slower = demand_source(reference).at(0.5)
    assert slower.time_s.size == pytest.approx(2 * reference.time_s.size, abs=2)
    for axis in "XY":
        assert slower.position_mm[axis][-1] == reference.position_mm[axis][-1]
        speeds = [np.abs(np.diff(r.position_mm[axis])).max() for r in (slower, reference)]
        assert speeds[0] == pytest.approx(0.5 * speeds[1], rel=1e-3)


def test_rapids_are_not_judged_and_rests_are() -> None:
    """What the table does after the last line is that line's error."""
    program = "G0 X20\nG1 Y30 F15000\nM2".splitlines()
    source = program_source(list(interpret(program, Budget.of(CONFIG.nc))), CONFIG)
    stretch = source.stretch(source.at(1.0))
    assert set(stretch.tolist()) == {advising.RAPID, REST, 2}


def test_only_feeds_are_scaled() -> None:
    """Dwells and rapids stay."""
    motions = list(interpret(PROGRAM, Budget.of(CONFIG.nc)))
    halved = at_shares(motions, lambda _: 0.5)
    assert [m.feed for m in halved if isinstance(m, Feed)] == [7500.0, 7500.0]
    assert [m for m in halved if isinstance(m, Dwell)] == [m for m in motions if isinstance(m, Dwell)]


@pytest.mark.parametrize(
    ("errors", "bracket"),
    [
        ({1.0: 10, 0.5: 5}, (1.0, 1.0)),
        ({1.0: 30, 0.5: 10}, (0.5, 1.0)),
        ({1.0: 30, 0.5: 30}, (0.0, 0.5)),
        ({1.0: 10, 0.5: 30, 0.25: 10}, (0.25, 0.5)),
    ],
)
def test_what_is_held_is_held_at_every_lower_feed(errors: dict[float, float], bracket: tuple[float, float]) -> None:
    """The highest share below which nothing leaves the tolerance of 20."""
    tried = {share: {7: (float(error), 0)} for share, error in errors.items()}
    assert advising._bracket(tried, 7, 20.0) == bracket
