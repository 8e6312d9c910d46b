"""Overlays the model on a recorded rapid: the outcome of a replay, and the motion of the modelled drive."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import MachineConfig
from fdhil.identification import align_speed_to_samples
from fdhil.pipeline.identified_loops import LoopTracker
from fdhil.pipeline.window_analysis import GAVE_UP, analyse_window, estimate_window, select_matching_axis
from fdhil.records import LoopEstimate, Result, Window, WindowOutcome
from fdhil.validation import (
    Replay,
    SimulatedMotion,
    TableAssessment,
    WindowSignals,
    replay_with_load_search,
    simulate_from_voltage,
)

NO_MODEL = {Result.NOT_FINITE, Result.DIVERGED}


@dataclass(frozen=True, slots=True, eq=False)
class ModelOverlay:
    """A rapid with its model: ``outcome`` of a replay, and ``window`` with the speed aligned to its rows.

    ``driven`` is the drive simulated from the measured voltage, the basis of the explained share of the speed.
    ``followed`` is the closed loop along the demand, the basis of the residual at the table. None: it cannot be
    simulated.
    """

    window: Window
    outcome: WindowOutcome
    driven: SimulatedMotion | None = None
    followed: Replay | None = None


def overlay_model(window: Window, config: MachineConfig, loops: LoopEstimate | None = None) -> ModelOverlay:
    """Analyse a window as the daemon would now, and simulate the result; never raises, whatever the data.

    ``loops`` are the newest identified ones of the axis in the history.
    """
    settings, period_s = config.identification, config.machine.sync_period_s
    section = LoopTracker(config.axis.get(window.axis), settings, period_s, loops).axis
    outcome = analyse_window(window, settings, section, period_s)
    aligned, axis = align_speed_to_samples(window, settings.speed_source), select_matching_axis(window, section)
    bare = ModelOverlay(aligned, outcome)
    if outcome.estimate is None or outcome.estimate.result in NO_MODEL:
        return bare
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            found = estimate_window(WindowSignals(aligned, settings, axis, period_s, recorded=window))
            assert found.estimate is not None
            driven = simulate_from_voltage(aligned, found.estimate, found.fit)
            followed = None
            if axis is not None and found.parameters is not None and TableAssessment(found).budget is not None:
                followed = replay_with_load_search(aligned, found.parameters, axis, period_s)
    except GAVE_UP:
        return bare
    return replace(bare, driven=driven, followed=followed)
