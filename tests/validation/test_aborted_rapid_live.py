"""A rapid aborted on the running machine: its window is extracted and refused with its code."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fdhil.pipeline import AxisPipeline, Record
from fdhil.records import (
    AxisSamples,
    MoveEvent,
    MoveKind,
    ParameterSet,
    TickTimes,
    WindowOutcome,
    freeze_array,
    freeze_integers,
)
from studies import drives
from studies.drives import Array
from studies.scenes import demand_of, measure_run
from tests.daemon.simulated_machine import config_of
from tests.validation.test_interruptions import DRIVE, MOVE, SCENE

BLOCK = 40


def _record_live_rapid(rates: Array) -> list[Record]:
    rows = measure_run(
        np.random.default_rng(7),
        SCENE,
        drives.simulate_loop(DRIVE, demand_of(SCENE, np.concatenate([rates, drives.make_standstill(0.4)])), SCENE.dt_s),
    ).signals
    n, begin = rows["speed"].size, round(SCENE.lead_s / SCENE.dt_s)
    events = [
        MoveEvent("X", MoveKind.RAPID, begin, "test"),
        MoveEvent("X", MoveKind.REST, begin + rates.size + 60, "test"),
    ]
    records: list[Record] = []
    for start in range(0, n, BLOCK):
        tick = np.arange(start, min(n, start + BLOCK))
        zeros = np.zeros(tick.size)
        records.append(TickTimes(freeze_integers(tick), freeze_integers(tick * 1_000_000)))
        records.append(
            AxisSamples(
                "X",
                freeze_integers(tick),
                demand_mm=freeze_array(1e3 * rows["demand"][tick]),
                position_mm=freeze_array(1e3 * rows["position"][tick]),
                speed_rad_s=freeze_array(rows["speed"][tick]),
                current_a=freeze_array(rows["current"][tick]),
                voltage_v=freeze_array(rows["voltage"][tick]),
                offset_mm=freeze_array(zeros),
                statusword=freeze_integers(zeros),
            )
        )
        records += [event for event in events if tick[0] <= event.tick <= tick[-1]]
    return records


def _collect_outcomes(folder: Path, rates: Array) -> tuple[list[WindowOutcome], bool]:
    pipeline = AxisPipeline("X", config_of(folder))
    reported = [outcome for record in _record_live_rapid(rates) for outcome in pipeline.process_record(record)]
    windows = [outcome for outcome in reported if isinstance(outcome, WindowOutcome)]
    return windows, any(isinstance(outcome, ParameterSet) for outcome in reported)


def test_complete_rapid_is_accepted_and_published(tmp_path: Path) -> None:
    (outcome,), published = _collect_outcomes(tmp_path, drives.compute_path_speeds(MOVE))
    assert outcome.verdict.accepted, outcome.verdict.reasons
    assert published


@pytest.mark.parametrize(
    "rate",
    [
        pytest.param(lambda t: 1 - 0.4 * np.clip((t - 0.3) / 0.05, 0, 1), id="override to 60 %"),
        pytest.param(
            lambda t: 1 - 0.7 * np.clip(np.minimum((t - 0.3) / 0.1, (0.7 - t) / 0.1), 0, 1), id="held a while"
        ),
    ],
)
def test_override_change_is_refused_and_not_published(tmp_path: Path, rate: Callable[[Array], Array]) -> None:
    (outcome,), published = _collect_outcomes(tmp_path, drives.compute_path_speeds(MOVE, rate))
    assert [reason.code for reason in outcome.verdict.reasons] == ["EpisodeAborted"]
    assert not published
