"""Outcomes and parameters as JSON documents, values to full precision. Imports nothing heavy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from fdhil.records import INTERVAL_95, PARAMETERS, UNITS, Notice, Outcome, ParameterSet, Skill, WindowOutcome
from fdhil.store.history import described


def parameters_status(published: ParameterSet) -> Mapping[str, Mapping[str, Any]]:
    """Return each parameter with its standard deviation and 95 % interval; nothing is told without its interval."""
    told = {}
    variances = np.diag(published.covariance)
    deviations = np.sqrt(np.where(variances >= 0, variances, np.nan))
    for k, name in enumerate(PARAMETERS):
        value, std = float(getattr(published.parameters, name)), float(deviations[k])
        half = INTERVAL_95 * std
        known = math.isfinite(half)
        told[name] = {
            "value": value,
            "std": std if known else None,
            "low": value - half if known else None,
            "high": value + half if known else None,
            "unit": UNITS[name],
        }
    return told


def set_document(published: ParameterSet) -> dict[str, Any]:
    """Return a published set as JSON has it."""
    return {
        "axis": published.axis,
        "revision": published.revision,
        "windows_used": published.windows,
        "tick": published.tick,
        "temperature_c": published.temperature_c,
        "parameters": parameters_status(published),
    }


def as_document(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome as JSON has it; ``kind`` is window, parameters, skill or notice."""
    if isinstance(outcome, WindowOutcome):
        return _window(outcome)
    if isinstance(outcome, ParameterSet):
        return {"kind": "parameters", **set_document(outcome)}
    assert isinstance(outcome, Skill | Notice)
    return {"kind": "skill" if isinstance(outcome, Skill) else "notice", **asdict(outcome)}


def _window(outcome: WindowOutcome) -> dict[str, Any]:
    window, verdict = outcome.window, outcome.verdict
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
        "parameters": {name: told | {"unit": UNITS[name]} for name, told in described(outcome).items()},
        "delay_s": _delay(outcome),
    }


def _delay(outcome: WindowOutcome) -> dict[str, Any] | None:
    """Return by how much the voltage is late against current and speed; None where that was not estimated."""
    estimate = outcome.estimate
    if estimate is None or estimate.delay_s is None or not math.isfinite(estimate.delay_s):
        return None
    std = estimate.delay_std_s
    return {"value": estimate.delay_s, "std": std if std is not None and math.isfinite(std) else None, "unit": "s"}
