"""Predicts the path error of the closed loops: axis errors, contour error, zones, and the model's own skill."""

from __future__ import annotations

from fdhil.prediction.contour_error import compute_contour_error_um
from fdhil.prediction.contour_uncertainty import compute_contour_std_um, compute_sensitivity_um
from fdhil.prediction.model_skill import assess_model_skill
from fdhil.prediction.path_prediction import predict_corrected_path, predict_path

__all__ = [
    "assess_model_skill",
    "compute_contour_error_um",
    "compute_contour_std_um",
    "compute_sensitivity_um",
    "predict_corrected_path",
    "predict_path",
]
