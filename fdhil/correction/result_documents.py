"""Builds the JSON documents of a prediction, of a correction, and of advised feeds without and with the correction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction.correction_planner import plan_correction
from fdhil.prediction import (
    CorrectionGain,
    FeedAdvice,
    FeedResult,
    FeedScaledPath,
    advise_feeds,
    compute_required_shares,
    make_demand_sources,
    make_program_source,
)
from fdhil.program import Motion
from fdhil.records import Correction, Float, Parameters, Prediction, Reason, Trajectory, compute_rms


def build_prediction_document(predicted: Prediction, models: Mapping[str, Parameters]) -> dict[str, Any]:
    """Return a prediction: its duration, the error of each axis and of the contour, and its zones."""
    return {
        "duration_s": round(float(predicted.reference.time_s[-1] - predicted.reference.time_s[0]), 6),
        "axes": {
            axis: {"rms_error_um": compute_rms(error), "max_error_um": float(abs(error).max())}
            for axis, error in predicted.error_um.items()
        },
        "seen_at": list_prediction_points(models),
        "contour": build_contour_document(predicted),
        "zones": build_zone_documents(predicted),
        "notes": build_reason_documents(predicted.reference.notes),
    }


def build_correction_document(
    program: str, planned: Correction, predicted: CorrectionGain, models: Mapping[str, Parameters]
) -> dict[str, Any]:
    """Return a correction: the prediction without it, its residual, its gain, and why it is refused if it is."""
    before, after = (
        build_contour_document(planned.before),
        build_contour_document(planned.after) | {"rms_um": predicted.after_um},
    )
    return {
        "schema": "fdhil-correct-1",
        "program": program,
        "method": planned.method,
        **build_prediction_document(planned.before, models),
        "before": before,
        "after": {**after, "uncertainty_um": predicted.half_um},
        "gain": before["rms_um"] / after["rms_um"] if after["rms_um"] > 0 else 1.0,
        "gain_at_least": predicted.at_least,
        "delay_s": planned.delay_s,
        "max_offset_um": {axis: float(abs(offset).max()) for axis, offset in planned.offset_um.items()},
        "refused": build_reason_documents(planned.refused),
        "warnings": build_reason_documents(planned.warnings),
    }


def build_contour_document(predicted: Prediction) -> dict[str, float]:
    """Return RMS and largest contour error."""
    return {"rms_um": predicted.rms_um, "max_um": float(predicted.contour_um.max())}


def list_prediction_points(models: Mapping[str, Parameters]) -> dict[str, str]:
    """Return per axis the point of prediction: the table if the model has a resonance, else the encoder."""
    return {axis: "table" if model.get_term("resonance") else "encoder" for axis, model in models.items()}


def build_zone_documents(predicted: Prediction) -> list[dict[str, Any]]:
    """Return the zones with the line of each one's largest error."""
    return [
        {
            "start_s": z.start_s,
            "end_s": z.end_s,
            "where": z.where,
            "line": int(predicted.reference.line[predicted.find_worst_row(z)]),
            "max_um": z.max_um,
            "cause": z.cause,
        }
        for z in predicted.zones
    ]


def build_reason_documents(reasons: Sequence[Reason]) -> list[dict[str, str]]:
    """Return reasons: class, text and advice of each."""
    return [asdict(reason) for reason in reasons]


def make_feed_sources(
    motions: Sequence[Motion] | None,
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
) -> tuple[FeedScaledPath, FeedScaledPath | None]:
    """Return the path at other feeds; of a demand (``motions`` None) a cautious and a hopeful one."""
    if motions is None:
        return make_demand_sources(reference, models, config, tolerance_um)
    return make_program_source(list(motions), config), None


def advise_with_correction(
    sure: FeedScaledPath,
    hopeful: FeedScaledPath | None,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
) -> tuple[tuple[FeedAdvice, ...], dict[float, FeedAdvice] | None]:
    """Return the advice by the sure source, and that by the hopeful one by the start of each segment.

    The correction is tried if every axis allows one.
    """
    corrects = all(config.axis[axis].correction is not None for axis in models)
    judge = (lambda slower: predict_corrected_contour_um(slower, models, config)) if corrects else None
    advice = advise_feeds(sure, models, config, tolerance_um, judge)
    if not hopeful:
        return advice, None
    return advice, {a.start_s: a for a in advise_feeds(hopeful, models, config, tolerance_um, judge)}


def predict_corrected_contour_um(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig
) -> Float:
    """Return the contour error (n,) with the correction; if refused, inf in the rows at fault, NaN in the others."""
    planned = plan_correction(reference, models, config)
    if not planned.refused:
        return planned.after.contour_um
    before, fault = planned.before, np.zeros(reference.time_s.size, dtype=np.bool_)
    for zone in before.zones:
        if zone.cause == "saturation":
            fault |= (reference.time_s >= zone.start_s) & (reference.time_s < zone.end_s)
    for axis in reference.axes:
        asked = compute_required_shares(reference.position_mm[axis], models[axis], config.axis[axis], reference.dt_s)
        limits = config.axis[axis].correction
        room_um = limits.max_offset_um if limits else 0.0
        fault |= (np.maximum(*asked) > 1.0) | (np.abs(before.error_um[axis]) > room_um)
    return np.where(fault, np.inf, np.nan) if fault.any() else before.contour_um


def build_advice_document(advice: FeedAdvice, most: Mapping[float, FeedAdvice] | None) -> dict[str, Any]:
    """Return the JSON document of a segment's advice; ``most`` is the advice by the hopeful source."""
    axis, what, share = advice.load
    asked = {"axis": axis, "what": what, "share": share}
    document = {
        "line": advice.line,
        "start_s": round(advice.start_s, 6),
        "end_s": round(advice.end_s, 6),
        "where": advice.where,
        "cause": advice.cause,
        "axis": advice.axis,
        "error_um": advice.error_um,
        "load": asked,
        "beyond": asked if share > 1.0 else None,
        "feed_mm_min": advice.feed_mm_min,
        **_build_feed_document("", advice.plain, advice.feed_mm_min),
        **_build_feed_document("corrected_", advice.corrected, advice.feed_mm_min),
    }
    if most is not None:
        other = most.get(advice.start_s, advice)
        document["hopeful_feed_mm_min"] = _convert_to_feed(other.plain, advice.feed_mm_min)
        document["corrected_hopeful_feed_mm_min"] = _convert_to_feed(other.corrected, advice.feed_mm_min)
    return document


def _build_feed_document(name: str, held: FeedResult | None, feed_mm_min: float) -> dict[str, float | None]:
    return {
        f"{name}feed_share": None if held is None else held.share,
        f"{name or 'advised_'}feed_mm_min": _convert_to_feed(held, feed_mm_min),
        f"{name}tried_feed_mm_min": None if held is None else held.tried * feed_mm_min,
        f"{name}run_feed_mm_min": None if held is None else held.run * feed_mm_min,
        f"{name}left_um": None if held is None or not math.isfinite(held.residual_um) else held.residual_um,
    }


def _convert_to_feed(held: FeedResult | None, feed_mm_min: float) -> float | None:
    return None if held is None or held.share is None else held.share * feed_mm_min
