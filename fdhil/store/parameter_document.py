"""Formats a published parameter set for JSON: each value with its interval, to full precision."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fdhil.records import INTERVAL_95, PARAMETERS, ParameterSet, get_unit


def report_parameters(published: ParameterSet) -> Mapping[str, Mapping[str, Any]]:
    """Return each parameter with its standard deviation and 95 % interval."""
    values, deviations = published.parameters.as_dict(), _compute_deviations(published)
    return {name: _format_figures(name, value, deviations[k]) for k, (name, value) in enumerate(values.items())}


def report_terms(published: ParameterSet) -> Mapping[str, Mapping[str, Any]]:
    """Return each additional term with its standard deviation and 95 % interval."""
    deviations = _compute_deviations(published)
    pairs = enumerate(published.parameters.terms, start=len(PARAMETERS))
    return {name: _format_figures(name, value, deviations[k]) for k, (name, value) in pairs}


def _compute_deviations(published: ParameterSet) -> list[float]:
    variances = np.diag(published.covariance)
    known = np.sqrt(np.where(variances >= 0, variances, np.nan)).tolist()
    return [*known, *[math.nan] * (len(PARAMETERS) + len(published.parameters.terms) - len(known))]


def _format_figures(name: str, value: float, std: float) -> Mapping[str, Any]:
    half = INTERVAL_95 * std
    known = math.isfinite(half)
    return {
        "value": value,
        "std": std if known else None,
        "low": value - half if known else None,
        "high": value + half if known else None,
        "unit": get_unit(name),
    }


def make_set_document(published: ParameterSet) -> dict[str, Any]:
    return {
        "axis": published.axis,
        "revision": published.revision,
        "windows_used": published.windows,
        "tick": published.tick,
        "temperature_c": published.temperature_c,
        "parameters": report_parameters(published),
        "terms": report_terms(published),
        "loops": published.loops,
        "unexplained_um": published.unexplained_um,
        "warnings": [str(warning) for warning in published.warnings],
    }
