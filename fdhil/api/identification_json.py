"""Builds the JSON that ``fdhil identify --json`` writes (schema fdhil-identify-1)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from fdhil.api.loop_comparison import compare_loops
from fdhil.api.recording_analysis import FileResult
from fdhil.config import Axis
from fdhil.identification import NO_VOLTAGE, bound_estimate, find_moving_range
from fdhil.records import PARAMETERS, UNITS, Estimate, Verdict, WindowOutcome, get_unit

SCHEMA = "fdhil-identify-1"


def build_identification_document(
    results: Sequence[FileResult], axes: Mapping[str, Axis], *, with_loops: bool = False
) -> dict[str, Any]:
    """Return the document of several recordings."""
    return {"schema": SCHEMA, "files": [build_file_document(result, axes, with_loops) for result in results]}


def build_file_document(result: FileResult, axes: Mapping[str, Axis], with_loops: bool) -> dict[str, Any]:
    document = {
        "file": result.file,
        "axis": result.axis,
        "windows": [_build_window_document(outcome) for outcome in result.outcomes],
        "pooled": {
            "parameters": _describe_parameters(result.pooled, result.verdict),
            "terms": _describe_terms(result.pooled),
            "validated": result.verdict.accepted,
            "windows_used": count_windows_used(result),
            "held_out": None if result.held_out is None else asdict(result.held_out),
            **_describe_verdict(result.verdict),
        },
    }
    if with_loops or result.loops is not None:
        document["loops"] = compare_loops(result.loops, axes.get(result.axis or ""))
    return document if result.error is None else document | {"error": result.error}


def count_windows_used(result: FileResult) -> int:
    """Return the number of windows in the pool."""
    if result.pooled is None:
        return 0
    return sum(outcome.verdict.accepted for outcome in result.outcomes)


def _build_window_document(outcome: WindowOutcome) -> dict[str, Any]:
    window, estimate = outcome.window, select_usable_estimate(outcome)
    first, last = find_moving_range(window)
    delay = describe_voltage_delay(estimate)
    return {
        "start_s": round(window.start_s + first * window.dt_s, 6),
        "end_s": round(window.start_s + last * window.dt_s, 6),
        "direction": window.direction,
        "parameters": _describe_parameters(estimate, outcome.verdict),
        "terms": _describe_terms(estimate),
        "validated": outcome.verdict.accepted,
        "fit_percent": outcome.verdict.fit_percent,
        **_describe_verdict(outcome.verdict),
        **({"delay_s": delay} if delay is not None else {}),
        **({"at_table": asdict(outcome.at_table)} if outcome.at_table is not None else {}),
    }


def select_usable_estimate(outcome: WindowOutcome) -> Estimate | None:
    """Return the estimate of a window; of a validated one, within the physical bounds that predict and correct use."""
    if outcome.estimate is None or not outcome.verdict.accepted:
        return outcome.estimate
    return bound_estimate(outcome.estimate, outcome.window.direction if outcome.window.is_rapid else None)


def _describe_verdict(verdict: Verdict) -> dict[str, Any]:
    return {
        "unexplained_um": verdict.unexplained_um,
        "reasons": [str(reason) for reason in verdict.reasons],
        "warnings": [str(reason) for reason in verdict.warnings],
    }


def _describe_terms(estimate: Estimate | None) -> dict[str, Any]:
    if estimate is None:
        return {}
    return {
        n: {"value": estimate.get_value(n), "std": estimate.get_std(n), "unit": get_unit(n)} for n in estimate.terms
    }


def describe_voltage_delay(estimate: Estimate | None) -> dict[str, Any] | None:
    """Return the delay of the voltage against current and speed; None where it was not estimated."""
    if estimate is None or estimate.delay_s is None or estimate.delay_std_s is None:
        return None
    if not (math.isfinite(estimate.delay_s) and math.isfinite(estimate.delay_std_s)):
        return None
    return {"value": estimate.delay_s, "std": estimate.delay_std_s, "unit": "s"}


def _describe_parameters(estimate: Estimate | None, verdict: Verdict) -> dict[str, Any]:
    """Return value, std and unit of each parameter, or null and the reason; R and L from the data sheet are null."""
    answer: dict[str, Any] = {}
    for name in PARAMETERS:
        if estimate is not None and name in estimate.given:
            given = {"value": estimate.get_value(name), "std": 0.0, "unit": UNITS[name]}
            answer[name] = {**given, "given": True} if name == "K" else {"value": None, "reason": str(NO_VOLTAGE)}
            continue
        if estimate is not None and math.isfinite(estimate.get_value(name)) and math.isfinite(estimate.get_std(name)):
            answer[name] = {"value": estimate.get_value(name), "std": estimate.get_std(name), "unit": UNITS[name]}
            continue
        reason = estimate.missing.get(name) if estimate is not None else None
        reason = reason or (verdict.reasons[0] if verdict.reasons else None)
        answer[name] = {"value": None, "reason": str(reason) if reason is not None else "NotFinite: no estimate"}
    return answer
