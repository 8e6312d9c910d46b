"""Tells what a correction is predicted to gain, with the uncertainty that the prediction knows of itself.

What the model says of its own correction is the model against itself. What can be reached is bounded by how well the
parameters are known, and by how well the last recorded moves were predicted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fdhil.config import MachineConfig
from fdhil.prediction.uncertainty import contour_std_um
from fdhil.records import INTERVAL_95, Correction, Float, Parameters, Skill, rms


class Gain(NamedTuple):
    """RMS contour error without and with a correction, um; ``half_um`` is half the 95 % interval, None: not known."""

    before_um: float
    after_um: float
    half_um: float | None

    @property
    def at_least(self) -> float | None:
        """By what factor the error is at least predicted to shrink; None when nothing better than 1 is known."""
        if self.half_um is None or self.after_um + self.half_um <= 0.0:
            return None
        factor = self.before_um / (self.after_um + self.half_um)
        return factor if factor > 1.0 else None

    def __str__(self) -> str:
        if self.half_um is None:
            return f"{self.after_um:.2f} um RMS by the model alone, how well it fits this machine is not known here"
        return f"{self.after_um:.2f} {plus_minus(self.half_um, 2)} um RMS"


def plus_minus(half: float, decimals: int = 1) -> str:
    """Return half an interval as text; what the digits cannot show is said to be smaller than they.

    >>> plus_minus(0.44), plus_minus(0.004)
    ('± 0.4', '± <0.1')
    """
    shown = f"{half:.{decimals}f}"
    return f"± {shown}" if float(shown) > 0.0 else f"± <{10.0**-decimals:.{decimals}f}"


def gain(
    planned: Correction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    covariances: Mapping[str, Float],
    skills: Mapping[str, Sequence[Skill]],
) -> Gain:
    """Return what a correction is predicted to gain.

    ``covariances`` (6, 6) and ``skills``, those of the last recorded moves, are per axis; where an axis that moves has
    none the uncertainty is not known.
    """
    reference = planned.before.reference
    moving = [axis for axis in reference.axes if np.ptp(reference.position_mm[axis]) > 0.0]
    half = None
    if all(axis in covariances for axis in moving):
        known = {axis: covariances.get(axis, np.zeros((6, 6))) for axis in reference.axes}
        std_um = contour_std_um(reference, models, known, config, planned.offset_um)
        skill_um = skill_of(skills, moving)
        half = None if skill_um is None else math.hypot(INTERVAL_95 * rms(std_um), skill_um)
    return Gain(planned.before.rms_um, planned.after.rms_um, half)


def skill_of(skills: Mapping[str, Sequence[Skill]], axes: Sequence[str]) -> float | None:
    """Return how well the last moves were predicted, um RMS over the axes, by the worst of each; None without any."""
    if not axes or not all(skills.get(axis) for axis in axes):
        return None
    um = math.hypot(*(float(np.max([skill.rms_um for skill in skills[axis]])) for axis in axes))
    return um if math.isfinite(um) else None
