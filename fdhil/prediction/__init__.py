"""What the closed loops will leave of a path: axis errors, contour error, the zones where it stands out, and the skill
of such a prediction on recorded moves."""

from __future__ import annotations

from fdhil.prediction.contour import contour_error_um
from fdhil.prediction.model_skill import skill
from fdhil.prediction.predict import predict, predict_corrected
from fdhil.prediction.uncertainty import contour_std_um, sensitivity_um

__all__ = ["contour_error_um", "contour_std_um", "predict", "predict_corrected", "sensitivity_um", "skill"]
