"""A drive with a filter that is not configured is assessed by the loops that its own rapids show."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fdhil.config import Identification
from fdhil.identification.drive_loops.loop_identification import DIFFER
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import AxisPipeline, Known, analyse, pool
from fdhil.pipeline.identified_loops import OwnLoops, better_axis, loops_of, mechanics_of, suspected
from fdhil.records import LoopEstimate, ParameterSet, Reason, Verdict, WindowOutcome, freeze_array
from fdhil.validation.table_error_budget import LOOPS_DIFFER
from studies.bench import shuttle
from studies.real_plant import Loops, Mechanics, Sensors, recording, run
from tests.bench import bench_config

AXIS = bench_config().axis["X"]
SETTINGS = Identification()
PERIOD_S = 1e-3


def outcomes(loops: Loops) -> list[WindowOutcome]:
    moved = run(Mechanics(), shuttle(moves=2), loops)
    windows = find_windows(recording(moved, Mechanics(), Sensors(), 0.5))
    return [analyse(window, SETTINGS, AXIS, PERIOD_S) for window in windows]


@pytest.fixture(scope="module")
def filtered() -> list[WindowOutcome]:
    """Rapids of a drive that filters its speed over 1 ms."""
    return outcomes(replace(Loops(), speed_filter_s=0.001))


@pytest.mark.usefixtures("long_computation")
def test_other_loops_are_named_and_then_used(filtered: list[WindowOutcome]) -> None:
    for outcome in filtered:
        assert [reason.code for reason in outcome.verdict.reasons] == [LOOPS_DIFFER]
    assert suspected(filtered)
    found = loops_of(filtered, AXIS, SETTINGS, PERIOD_S)
    assert found is not None
    told = dict(zip(found.names, found.values.tolist(), strict=True))
    assert told["speed_filter_s"] == pytest.approx(0.001, rel=0.05)
    assert told["speed_kp"] == pytest.approx(AXIS.regulators.speed_kp, rel=0.05)
    better = better_axis(AXIS, found)
    assert better is not None
    again = [analyse(outcome.window, SETTINGS, better, PERIOD_S) for outcome in filtered]
    assert all(outcome.verdict.accepted for outcome in again)


@pytest.mark.usefixtures("long_computation")
def test_a_running_machine_goes_on_with_its_own_loops(filtered: list[WindowOutcome]) -> None:
    loops = OwnLoops(AXIS, SETTINGS, PERIOD_S)
    first, found = loops.analyse(filtered[0].window)
    assert found is not None
    assert first.verdict.accepted
    assert loops.axis is not None
    assert loops.axis.regulators.speed_filter_s == pytest.approx(0.001, rel=0.05)
    changed = loops.changed
    assert changed is not None
    assert changed["speed_filter_s"] == loops.axis.regulators.speed_filter_s
    second, again = loops.analyse(filtered[1].window)
    assert again is None
    assert second.verdict.accepted
    after_restart = OwnLoops(AXIS, SETTINGS, PERIOD_S, known=found)
    assert after_restart.axis is not None
    assert after_restart.axis.regulators == loops.axis.regulators


def test_published_set_has_the_loops_it_was_validated_with(filtered: list[WindowOutcome]) -> None:
    verdict = Verdict(True, None, (), 0.1, (Reason(DIFFER, "the configured ones leave 28 um"),))
    found = LoopEstimate("X", "p_pi_pi", ("speed_filter_s",), freeze_array([1e-3]), freeze_array([[1e-10]]), verdict)
    outcomes = AxisPipeline("X", bench_config("X"), known=Known(loops=found)).feed(filtered[0].window)
    (published,) = (outcome for outcome in outcomes if isinstance(outcome, ParameterSet))
    assert published.loops == {"speed_filter_s": 1e-3}


def test_loops_that_explain_the_rapids_are_left_alone() -> None:
    assert not suspected(outcomes(Loops()))


def test_loops_are_sought_with_a_weight_beyond_dry_friction_as_a_load() -> None:
    mechanics = Mechanics(Cd=1.0, load_nm=5.8)
    moved = run(mechanics, shuttle(moves=2), Loops())
    windows = find_windows(recording(moved, mechanics, Sensors(), 0.5))
    plants = [mechanics_of(analyse(window, SETTINGS, AXIS, PERIOD_S), AXIS) for window in windows]
    lifted, lowered = (plant for plant in plants if plant is not None)
    assert lifted.get_term("load") == lowered.Cd == 0.0
    assert lifted.Cd == pytest.approx(6.8, abs=0.3)
    assert lowered.get_term("load") == pytest.approx(4.8, abs=0.3)


def test_pool_is_refused_where_half_of_the_rapids_refute_the_loops_of_the_others(
    filtered: list[WindowOutcome],
) -> None:
    accepted = [replace(o, verdict=replace(o.verdict, accepted=True, reasons=())) for o in filtered]
    assert pool([*accepted, filtered[0]], SETTINGS)[1].accepted
    _, verdict = pool([*accepted, *filtered], SETTINGS)
    assert not verdict.accepted
    (reason,) = verdict.reasons
    assert reason.code == LOOPS_DIFFER
    assert "2 rapids refute the loops with which 2 were accepted" in reason.text
