"""Outcomes and parameters as JSON documents, values to full precision. Imports nothing heavy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from fdhil.records import (
    INTERVAL_95,
    PARAMETERS,
    LoopEstimate,
    Notice,
    Outcome,
    ParameterSet,
    Skill,
    WindowOutcome,
    unit_of,
)
from fdhil.store.history import described, friction_of


def parameters_status(published: ParameterSet) -> Mapping[str, Mapping[str, Any]]:
    """Return each parameter with its standard deviation and 95 % interval; nothing is told without its interval."""
    values, deviations = published.parameters.as_dict(), _deviations(published)
    return {name: _figures(name, value, deviations[k]) for k, (name, value) in enumerate(values.items())}


def terms_status(published: ParameterSet) -> Mapping[str, Mapping[str, Any]]:
    """Return each term that joined the six parameters in the same way."""
    deviations = _deviations(published)
    pairs = enumerate(published.parameters.terms, start=len(PARAMETERS))
    return {name: _figures(name, value, deviations[k]) for k, (name, value) in pairs}


def _deviations(published: ParameterSet) -> list[float]:
    """Return the standard deviations of the six parameters and the terms, NaN where none is known."""
    variances = np.diag(published.covariance)
    known = np.sqrt(np.where(variances >= 0, variances, np.nan)).tolist()
    return [*known, *[math.nan] * (len(PARAMETERS) + len(published.parameters.terms) - len(known))]


def _figures(name: str, value: float, std: float) -> Mapping[str, Any]:
    half = INTERVAL_95 * std
    known = math.isfinite(half)
    return {
        "value": value,
        "std": std if known else None,
        "low": value - half if known else None,
        "high": value + half if known else None,
        "unit": unit_of(name),
    }


def set_document(published: ParameterSet) -> dict[str, Any]:
    """Return a published set as JSON has it."""
    return {
        "axis": published.axis,
        "revision": published.revision,
        "windows_used": published.windows,
        "tick": published.tick,
        "temperature_c": published.temperature_c,
        "parameters": parameters_status(published),
        "terms": terms_status(published),
        "unexplained_um": published.unexplained_um,
        "warnings": [str(warning) for warning in published.warnings],
    }


def as_document(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome as JSON has it; ``kind`` is window, parameters, skill, notice or loops."""
    if isinstance(outcome, WindowOutcome):
        return _window(outcome)
    if isinstance(outcome, ParameterSet):
        return {"kind": "parameters", **set_document(outcome)}
    if isinstance(outcome, LoopEstimate):
        return loops_document(outcome)
    assert isinstance(outcome, Skill | Notice)
    return {"kind": "skill" if isinstance(outcome, Skill) else "notice", **asdict(outcome)}


def loops_document(found: LoopEstimate) -> dict[str, Any]:
    """Return what rapids show of the drive's own loops as JSON has it."""
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


def _window(outcome: WindowOutcome) -> dict[str, Any]:
    window, verdict = outcome.window, outcome.verdict
    told = {name: figures | {"unit": unit_of(name)} for name, figures in described(outcome).items()}
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
        "parameters": {name: figures for name, figures in told.items() if name not in terms},
        "terms": {name: figures for name, figures in told.items() if name in terms},
        "friction_at_rapid": friction_of(outcome),
        "delay_s": _delay(outcome),
        "at_table": None if outcome.at_table is None else asdict(outcome.at_table),
        "nc": None if window.nc is None else asdict(window.nc),
    }


def _delay(outcome: WindowOutcome) -> dict[str, Any] | None:
    """Return by how much the voltage is late against current and speed; None where that was not estimated."""
    estimate = outcome.estimate
    if estimate is None or estimate.delay_s is None or not math.isfinite(estimate.delay_s):
        return None
    std = estimate.delay_std_s
    return {"value": estimate.delay_s, "std": std if std is not None and math.isfinite(std) else None, "unit": "s"}
