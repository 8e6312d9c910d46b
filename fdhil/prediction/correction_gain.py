"""Predicts the gain of a correction, with its uncertainty.

The residual of the model's own correction compares the model with itself. A correction also leaves the model's residual
of recorded moves that it was not identified on: no larger gain is predicted than those moves show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdhil.config import MachineConfig
from fdhil.prediction.contour_uncertainty import compute_contour_std_um
from fdhil.records import INTERVAL_95, Correction, Float, Parameters, Skill, Trajectory, compute_rms

MARGIN = 1.5
"""A path turns and starts more often than the rapids that show what a model leaves, and tables deflect behind encoders.

``python -m studies.zoo``: without it the contour error at the table is up to 1.7 times as large as predicted.
"""


class CorrectionGain(NamedTuple):
    """RMS contour error without and with a correction, um; ``half_um`` is half the 95 % interval, None: not known.

    ``after_um`` includes what held-out moves show, where there are any.
    """

    before_um: float
    after_um: float
    half_um: float | None

    @property
    def at_least(self) -> float | None:
        """The least predicted factor by which the error shrinks; None unless more than 1 is known."""
        if self.half_um is None or self.after_um + self.half_um <= 0.0:
            return None
        factor = self.before_um / (self.after_um + self.half_um)
        return factor if factor > 1.0 else None

    def __str__(self) -> str:
        if self.half_um is None:
            return f"{self.after_um:.2f} um RMS by the model alone; its accuracy on this machine is unknown"
        return format_upper_limit(self.after_um, self.half_um)


def format_upper_limit(model_um: float, half_um: float) -> str:
    """Return a predicted RMS as text: the end of its 95 % interval first, as it is not symmetric.

    >>> format_upper_limit(0.08, 1.6)
    'at most 1.68 um RMS (95 %), 0.08 by the model'
    """
    return f"at most {model_um + half_um:.2f} um RMS (95 %), {model_um:.2f} by the model"


def format_half_interval(half: float, decimals: int = 1) -> str:
    """Return half an interval as text; a value below its digits is shown as smaller than they.

    >>> format_half_interval(0.44), format_half_interval(0.004)
    ('± 0.4', '± <0.1')
    """
    shown = f"{half:.{decimals}f}"
    return f"± {shown}" if float(shown) > 0.0 else f"± <{10.0**-decimals:.{decimals}f}"


def predict_gain(
    planned: Correction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    covariances: Mapping[str, Float],
    held_out_um: Mapping[str, float],
) -> CorrectionGain:
    """Return the predicted gain of a correction.

    ``covariances`` (6, 6), and ``held_out_um``, the model's RMS residual of moves that it was not identified on, are
    per axis; without held-out moves of a moving axis the uncertainty is unknown.
    """
    reference = planned.before.reference
    before_um, after_um = planned.before.rms_um, planned.after.rms_um
    left_um = combine_held_out_um(held_out_um, find_moving_axes(reference))
    if left_um is None:
        return CorrectionGain(before_um, after_um, None)
    known = {axis: covariances.get(axis, np.zeros((6, 6))) for axis in reference.axes}
    std_um = (
        compute_rms(compute_contour_std_um(reference, models, known, config, planned.offset_um)) if covariances else 0.0
    )
    predicted_um = after_um if planned.refused else add_held_out_um(after_um, left_um)
    return CorrectionGain(before_um, predicted_um, math.hypot(INTERVAL_95 * std_um, left_um))


def find_moving_axes(reference: Trajectory) -> tuple[str, ...]:
    """Return the axes that change their position."""
    return tuple(axis for axis, path in reference.position_mm.items() if np.ptp(path) > 0.0)


def add_held_out_um(after_um: float, left_um: float | None) -> float:
    """Return the RMS (um) of a correction, including the residual of held-out moves; None: there are none."""
    return after_um if left_um is None else math.hypot(after_um, MARGIN * left_um)


def find_worst_rms_um(skills: Mapping[str, Sequence[Skill]]) -> dict[str, float]:
    """Return the model's RMS residual of the last recorded moves, um, the worst of each axis that has any."""
    return {axis: float(np.max([skill.rms_um for skill in found])) for axis, found in skills.items() if found}


def find_largest_error_um(skills: Mapping[str, Sequence[Skill]]) -> dict[str, float]:
    """Return the model's largest error (um) in the last recorded moves, of each axis that has any."""
    return {axis: float(np.max([skill.max_um for skill in found])) for axis, found in skills.items() if found}


def combine_held_out_um(held_out_um: Mapping[str, float], axes: Sequence[str]) -> float | None:
    """Return the joint error (um) of held-out moves in plane or space; None if an axis has none."""
    if not axes or not all(axis in held_out_um for axis in axes):
        return None
    um = math.hypot(*(held_out_um[axis] for axis in axes))
    return um if math.isfinite(um) else None
