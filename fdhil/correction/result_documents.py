"""Builds the JSON documents of a prediction, of a correction, and of advised feeds without and with the correction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction.planning import plan
from fdhil.prediction.advise import Advice, Held, advise
from fdhil.prediction.feed_search import Source, program_source
from fdhil.prediction.gain import Gain
from fdhil.prediction.inverse_dynamics import required
from fdhil.prediction.retime import demand_sources
from fdhil.program import Motion
from fdhil.records import Correction, Float, Parameters, Prediction, Reason, Trajectory, compute_rms


def prediction_document(predicted: Prediction, models: Mapping[str, Parameters]) -> dict[str, Any]:
    """Return a prediction: its duration, the error of each axis and of the contour, and its zones."""
    return {
        "duration_s": round(float(predicted.reference.time_s[-1] - predicted.reference.time_s[0]), 6),
        "axes": {
            axis: {"rms_error_um": compute_rms(error), "max_error_um": float(abs(error).max())}
            for axis, error in predicted.error_um.items()
        },
        "seen_at": seen_at(models),
        "contour": contour(predicted),
        "zones": zones(predicted),
        "notes": reasons_document(predicted.reference.notes),
    }


def correction_document(
    program: str, planned: Correction, predicted: Gain, models: Mapping[str, Parameters]
) -> dict[str, Any]:
    """Return a correction: the prediction without it, its residual, its gain, and why it is refused if it is."""
    before, after = contour(planned.before), contour(planned.after) | {"rms_um": predicted.after_um}
    return {
        "schema": "fdhil-correct-1",
        "program": program,
        "method": planned.method,
        **prediction_document(planned.before, models),
        "before": before,
        "after": {**after, "uncertainty_um": predicted.half_um},
        "gain": before["rms_um"] / after["rms_um"] if after["rms_um"] > 0 else 1.0,
        "gain_at_least": predicted.at_least,
        "delay_s": planned.delay_s,
        "max_offset_um": {axis: float(abs(offset).max()) for axis, offset in planned.offset_um.items()},
        "refused": reasons_document(planned.refused),
        "warnings": reasons_document(planned.warnings),
    }


def contour(predicted: Prediction) -> dict[str, float]:
    """Return RMS and largest contour error."""
    return {"rms_um": predicted.rms_um, "max_um": float(predicted.contour_um.max())}


def seen_at(models: Mapping[str, Parameters]) -> dict[str, str]:
    """Return per axis the point of prediction: the table if the model has a resonance, else the encoder."""
    return {axis: "table" if model.get_term("resonance") else "encoder" for axis, model in models.items()}


def zones(predicted: Prediction) -> list[dict[str, Any]]:
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


def reasons_document(reasons: Sequence[Reason]) -> list[dict[str, str]]:
    """Return reasons: class, text and advice of each."""
    return [asdict(reason) for reason in reasons]


def sources(
    motions: Sequence[Motion] | None,
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
) -> tuple[Source, Source | None]:
    """Return the path at other feeds; of a demand (``motions`` None) a cautious and a hopeful one."""
    if motions is None:
        return demand_sources(reference, models, config, tolerance_um)
    return program_source(list(motions), config), None


def advised(
    sure: Source,
    hopeful: Source | None,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
) -> tuple[tuple[Advice, ...], dict[float, Advice] | None]:
    """Return the advice by the sure source, and that by the hopeful one by the start of each segment.

    The correction is tried if every axis allows one.
    """
    corrects = all(config.axis[axis].correction is not None for axis in models)
    judge = (lambda slower: corrected_contour_um(slower, models, config)) if corrects else None
    advice = advise(sure, models, config, tolerance_um, judge)
    if not hopeful:
        return advice, None
    return advice, {a.start_s: a for a in advise(hopeful, models, config, tolerance_um, judge)}


def corrected_contour_um(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig) -> Float:
    """Return the contour error (n,) with the correction; if refused, inf in the rows at fault, NaN in the others."""
    planned = plan(reference, models, config)
    if not planned.refused:
        return planned.after.contour_um
    before, fault = planned.before, np.zeros(reference.time_s.size, dtype=np.bool_)
    for zone in before.zones:
        if zone.cause == "saturation":
            fault |= (reference.time_s >= zone.start_s) & (reference.time_s < zone.end_s)
    for axis in reference.axes:
        asked = required(reference.position_mm[axis], models[axis], config.axis[axis], reference.dt_s)
        limits = config.axis[axis].correction
        room_um = limits.max_offset_um if limits else 0.0
        fault |= (np.maximum(*asked) > 1.0) | (np.abs(before.error_um[axis]) > room_um)
    return np.where(fault, np.inf, np.nan) if fault.any() else before.contour_um


def entry(advice: Advice, most: Mapping[float, Advice] | None) -> dict[str, Any]:
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
        **_held("", advice.plain, advice.feed_mm_min),
        **_held("corrected_", advice.corrected, advice.feed_mm_min),
    }
    if most is not None:
        other = most.get(advice.start_s, advice)
        document["hopeful_feed_mm_min"] = _feed(other.plain, advice.feed_mm_min)
        document["corrected_hopeful_feed_mm_min"] = _feed(other.corrected, advice.feed_mm_min)
    return document


def _held(name: str, held: Held | None, feed_mm_min: float) -> dict[str, float | None]:
    return {
        f"{name}feed_share": None if held is None else held.share,
        f"{name or 'advised_'}feed_mm_min": _feed(held, feed_mm_min),
        f"{name}tried_feed_mm_min": None if held is None else held.tried * feed_mm_min,
        f"{name}run_feed_mm_min": None if held is None else held.run * feed_mm_min,
        f"{name}left_um": None if held is None or not math.isfinite(held.left_um) else held.left_um,
    }


def _feed(held: Held | None, feed_mm_min: float) -> float | None:
    return None if held is None or held.share is None else held.share * feed_mm_min
