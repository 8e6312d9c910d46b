"""Predicts the path error of the closed loops: axis errors, contour error, zones, and the model's own skill."""

from __future__ import annotations

from fdhil.prediction.contour import contour_error_um
from fdhil.prediction.model_skill import skill
from fdhil.prediction.predict import predict, predict_corrected
from fdhil.prediction.uncertainty import contour_std_um, sensitivity_um

__all__ = ["contour_error_um", "contour_std_um", "predict", "predict_corrected", "sensitivity_um", "skill"]
