"""Encodes outcomes and parameters as JSON documents, values to full precision. Imports nothing heavy."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from fdhil.records import LoopEstimate, Notice, Outcome, ParameterSet, Skill, WindowOutcome, get_unit
from fdhil.store import format_friction, format_parameters, make_set_document


def build_outcome_document(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome as a JSON document; ``kind`` is window, parameters, skill, notice or loops."""
    if isinstance(outcome, WindowOutcome):
        return _build_window_document(outcome)
    if isinstance(outcome, ParameterSet):
        return {"kind": "parameters", **make_set_document(outcome)}
    if isinstance(outcome, LoopEstimate):
        return build_loops_document(outcome)
    assert isinstance(outcome, Skill | Notice)
    return {"kind": "skill" if isinstance(outcome, Skill) else "notice", **asdict(outcome)}


def build_loops_document(found: LoopEstimate) -> dict[str, Any]:
    """Return the identified control loops of a drive as a JSON document."""
    stds = np.sqrt(np.diag(found.covariance)).tolist()
    gains = zip(found.names, found.values.tolist(), stds, strict=True)
    return {
        "kind": "loops",
        "axis": found.axis,
        "structure": found.structure,
        "gains": {name: {"value": value, "std": std if math.isfinite(std) else None} for name, value, std in gains},
        "validated": found.verdict.accepted,
        "unexplained_um": found.verdict.unexplained_um,
        "configured_um": found.configured_um,
        "reasons": [str(reason) for reason in found.verdict.reasons],
        "warnings": [str(warning) for warning in found.verdict.warnings],
    }


def _build_window_document(outcome: WindowOutcome) -> dict[str, Any]:
    window, verdict = outcome.window, outcome.verdict
    all_figures = {name: figures | {"unit": get_unit(name)} for name, figures in format_parameters(outcome).items()}
    terms = outcome.estimate.terms if outcome.estimate else ()
    return {
        "kind": "window",
        "axis": window.axis,
        "start_s": window.start_s,
        "end_s": window.start_s + window.n * window.dt_s,
        "start_tick": window.start_tick,
        "direction": window.direction,
        "validated": verdict.accepted,
        "fit_percent": verdict.fit_percent,
        "reasons": [str(reason) for reason in verdict.reasons],
        "method": outcome.estimate and outcome.estimate.method,
        "unexplained_um": verdict.unexplained_um,
        "warnings": [str(warning) for warning in verdict.warnings],
        "parameters": {name: figures for name, figures in all_figures.items() if name not in terms},
        "terms": {name: figures for name, figures in all_figures.items() if name in terms},
        "friction_at_rapid": format_friction(outcome),
        "delay_s": _build_delay_document(outcome),
        "at_table": None if outcome.at_table is None else asdict(outcome.at_table),
        "nc": None if window.nc is None else asdict(window.nc),
    }


def _build_delay_document(outcome: WindowOutcome) -> dict[str, Any] | None:
    """Return the delay of the voltage against current and speed; None where it was not estimated."""
    estimate = outcome.estimate
    if estimate is None or estimate.delay_s is None or not math.isfinite(estimate.delay_s):
        return None
    std = estimate.delay_std_s
    return {"value": estimate.delay_s, "std": std if std is not None and math.isfinite(std) else None, "unit": "s"}
