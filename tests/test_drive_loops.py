"""A drive with a filter that its configuration does not know is judged by the loops that its own rapids show."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fdhil.config import Identification
from fdhil.identification.loops import better_loops
from fdhil.identification.windows import find_windows
from fdhil.pipeline import analyse, judged_again
from fdhil.pipeline.drive_loops import DriveLoops
from fdhil.records import WindowOutcome
from fdhil.validation.weight import LOOPS_DIFFER
from studies.bench import shuttle
from studies.real_plant import Loops, Mechanics, Sensors, recording, run
from tests.bench import bench_config

AXIS = bench_config().axis["X"]
SETTINGS = Identification()
PERIOD_S = 1e-3


def outcomes(loops: Loops) -> list[WindowOutcome]:
    """Return two rapids of the bench's axis with these loops, judged by the configured ones."""
    moved = run(Mechanics(), shuttle(moves=2), loops)
    windows = find_windows(recording(moved, Mechanics(), Sensors(), 0.5))
    return [analyse(window, SETTINGS, AXIS, PERIOD_S) for window in windows]


@pytest.fixture(scope="module")
def filtered() -> list[WindowOutcome]:
    """Rapids of a drive that filters its speed over 1 ms."""
    return outcomes(replace(Loops(), speed_filter_s=0.001))


def test_other_loops_are_named_and_then_used(filtered: list[WindowOutcome]) -> None:
    for outcome in filtered:
        assert [reason.code for reason in outcome.verdict.reasons] == [LOOPS_DIFFER]
    again, found = judged_again(filtered, SETTINGS, AXIS, PERIOD_S)
    assert found is not None
    told = dict(zip(found.names, found.values.tolist(), strict=True))
    assert told["speed_filter_s"] == pytest.approx(0.001, rel=0.05)
    assert told["speed_kp"] == pytest.approx(AXIS.regulators.speed_kp, rel=0.05)
    assert all(outcome.verdict.accepted for outcome in again)


def test_the_second_rapid_shows_them_on_a_running_machine(filtered: list[WindowOutcome]) -> None:
    loops = DriveLoops(AXIS, SETTINGS, PERIOD_S)
    assert loops.take(filtered[0]) is None
    assert loops.axis is AXIS
    found = loops.take(filtered[1])
    assert found is not None
    assert better_loops(found)
    assert loops.axis.regulators.speed_filter_s == pytest.approx(0.001, rel=0.05)
    after_restart = DriveLoops(AXIS, SETTINGS, PERIOD_S, known=found)
    assert after_restart.axis.regulators == loops.axis.regulators


def test_loops_that_explain_the_rapids_are_left_alone() -> None:
    good = outcomes(Loops())
    again, found = judged_again(good, SETTINGS, AXIS, PERIOD_S)
    assert found is None
    assert all(one is other for one, other in zip(again, good, strict=True))
