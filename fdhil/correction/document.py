"""Builds the JSON documents of a prediction and of a correction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from fdhil.prediction.gain import Gain
from fdhil.records import Correction, Parameters, Prediction, Reason, rms


def prediction_document(predicted: Prediction, models: Mapping[str, Parameters]) -> dict[str, Any]:
    """Return a prediction: its duration, the error of each axis and of the contour, and its zones."""
    return {
        "duration_s": round(float(predicted.reference.time_s[-1] - predicted.reference.time_s[0]), 6),
        "axes": {
            axis: {"rms_error_um": rms(error), "max_error_um": float(abs(error).max())}
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
    return {axis: "table" if model.term("resonance") else "encoder" for axis, model in models.items()}


def zones(predicted: Prediction) -> list[dict[str, Any]]:
    """Return the zones with the line of each one's largest error."""
    return [
        {
            "start_s": z.start_s,
            "end_s": z.end_s,
            "where": z.where,
            "line": int(predicted.reference.line[predicted.worst_row(z)]),
            "max_um": z.max_um,
            "cause": z.cause,
        }
        for z in predicted.zones
    ]


def reasons_document(reasons: Sequence[Reason]) -> list[dict[str, str]]:
    """Return reasons: class, text and advice of each."""
    return [asdict(reason) for reason in reasons]
