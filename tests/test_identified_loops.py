"""A drive with a filter that is not configured is assessed by the loops that its own rapids show."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fdhil.config import Identification
from fdhil.identification.drive_loops.loop_identification import DIFFER
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import AxisPipeline, PipelineState, analyse_window, pool_windows
from fdhil.pipeline.identified_loops import (
    LoopTracker,
    adopt_loops,
    complete_parameters,
    has_loop_mismatch,
    identify_from_outcomes,
)
from fdhil.records import LoopEstimate, ParameterSet, Reason, Verdict, WindowOutcome, freeze_array
from fdhil.validation.table_error_budget import LOOPS_DIFFER
from studies.bench import make_shuttle_demand
from studies.real_plant import Loops, Mechanics, Sensors, make_recording, simulate_axis
from tests.bench import bench_config

AXIS = bench_config().axis["X"]
SETTINGS = Identification()
PERIOD_S = 1e-3


def analyse_rapids(loops: Loops) -> list[WindowOutcome]:
    moved = simulate_axis(Mechanics(), make_shuttle_demand(moves=2), loops)
    windows = find_windows(make_recording(moved, Mechanics(), Sensors(), 0.5))
    return [analyse_window(window, SETTINGS, AXIS, PERIOD_S) for window in windows]


@pytest.fixture(scope="module")
def filtered_outcomes() -> list[WindowOutcome]:
    """Rapids of a drive that filters its speed over 1 ms."""
    return analyse_rapids(replace(Loops(), speed_filter_s=0.001))


@pytest.mark.usefixtures("long_computation")
def test_different_loops_are_reported_and_used(filtered_outcomes: list[WindowOutcome]) -> None:
    for outcome in filtered_outcomes:
        assert [reason.code for reason in outcome.verdict.reasons] == [LOOPS_DIFFER]
    assert has_loop_mismatch(filtered_outcomes)
    found = identify_from_outcomes(filtered_outcomes, AXIS, SETTINGS, PERIOD_S)
    assert found is not None
    reported = dict(zip(found.names, found.values.tolist(), strict=True))
    assert reported["speed_filter_s"] == pytest.approx(0.001, rel=0.05)
    assert reported["speed_kp"] == pytest.approx(AXIS.regulators.speed_kp, rel=0.05)
    better = adopt_loops(AXIS, found)
    assert better is not None
    again = [analyse_window(outcome.window, SETTINGS, better, PERIOD_S) for outcome in filtered_outcomes]
    assert all(outcome.verdict.accepted for outcome in again)


@pytest.mark.usefixtures("long_computation")
def test_running_machine_continues_with_identified_loops(filtered_outcomes: list[WindowOutcome]) -> None:
    loops = LoopTracker(AXIS, SETTINGS, PERIOD_S)
    first, found = loops.analyse_rapid(filtered_outcomes[0].window)
    assert found is not None
    assert first.verdict.accepted
    assert loops.axis is not None
    assert loops.axis.regulators.speed_filter_s == pytest.approx(0.001, rel=0.05)
    changed = loops.changed_regulators
    assert changed is not None
    assert changed["speed_filter_s"] == loops.axis.regulators.speed_filter_s
    second, again = loops.analyse_rapid(filtered_outcomes[1].window)
    assert again is None
    assert second.verdict.accepted
    after_restart = LoopTracker(AXIS, SETTINGS, PERIOD_S, known=found)
    assert after_restart.axis is not None
    assert after_restart.axis.regulators == loops.axis.regulators


def test_published_set_contains_its_loops(filtered_outcomes: list[WindowOutcome]) -> None:
    verdict = Verdict(True, None, (), 0.1, (Reason(DIFFER, "the configured ones leave 28 um"),))
    found = LoopEstimate("X", "p_pi_pi", ("speed_filter_s",), freeze_array([1e-3]), freeze_array([[1e-10]]), verdict)
    outcomes = AxisPipeline("X", bench_config("X"), known=PipelineState(loops=found)).process_record(
        filtered_outcomes[0].window
    )
    (published,) = (outcome for outcome in outcomes if isinstance(outcome, ParameterSet))
    assert published.loops == {"speed_filter_s": 1e-3}


def test_sufficient_loops_are_kept() -> None:
    assert not has_loop_mismatch(analyse_rapids(Loops()))


def test_loops_are_identified_with_overhauling_weight() -> None:
    mechanics = Mechanics(Cd=1.0, load_nm=5.8)
    moved = simulate_axis(mechanics, make_shuttle_demand(moves=2), Loops())
    windows = find_windows(make_recording(moved, mechanics, Sensors(), 0.5))
    plants = [complete_parameters(analyse_window(window, SETTINGS, AXIS, PERIOD_S), AXIS) for window in windows]
    lifted, lowered = (plant for plant in plants if plant is not None)
    assert lifted.get_term("load") == lowered.Cd == 0.0
    assert lifted.Cd == pytest.approx(6.8, abs=0.3)
    assert lowered.get_term("load") == pytest.approx(4.8, abs=0.3)


def test_pool_is_refused_if_half_of_rapids_refute_loops(
    filtered_outcomes: list[WindowOutcome],
) -> None:
    accepted = [replace(o, verdict=replace(o.verdict, accepted=True, reasons=())) for o in filtered_outcomes]
    assert pool_windows([*accepted, filtered_outcomes[0]], SETTINGS)[1].accepted
    _, verdict = pool_windows([*accepted, *filtered_outcomes], SETTINGS)
    assert not verdict.accepted
    (reason,) = verdict.reasons
    assert reason.code == LOOPS_DIFFER
    assert "2 rapids refute the loops with which 2 were accepted" in reason.text
