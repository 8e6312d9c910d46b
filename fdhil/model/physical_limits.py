"""Defines the physical bounds of a feed drive, shared by fits, verdicts, model files and predictions.

Friction never drives motion: its dry part is at least 0 in either direction, at rest as well as at speed, and so is its
viscous part. Divisors are above 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

ABOVE_ZERO = ("R", "L", "K", "Jt", "stribeck_speed", "resonance")
NOT_NEGATIVE = ("ft", "Cd", "coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative",
                "resonance_damping", "presliding_um")  # fmt: skip
LEAST_SHARE = 0.01  # of the inertia on either side of a spring: with less there is no second mass
LEAST_SPEED_RAD_S = 1e-3  # Stribeck speed: below it no sample resolves the fall of friction


@dataclass(frozen=True, slots=True)
class ParameterBound:
    """A weighted sum of named values that is at least ``least``; ``moves`` is the value to adjust when it is not."""

    weights: Mapping[str, float]
    least: float
    moves: str

    def compute_violation(self, values: Mapping[str, float]) -> float:
        """Return by how much the values violate the bound; 0 or less is within it."""
        return self.least - sum(weight * values[name] for name, weight in self.weights.items())


def list_bounds(names: Sequence[str]) -> list[ParameterBound]:
    """Return the bounds of a model with these parameters and terms, except those of R, L, K and Jt."""
    found = [ParameterBound({name: 1.0}, 0.0, name) for name in NOT_NEGATIVE if name in names]
    if "stribeck_speed" in names:
        found.append(ParameterBound({"stribeck_speed": 1.0}, LEAST_SPEED_RAD_S, "stribeck_speed"))
    if "resonance_share" in names:
        found += [ParameterBound({"resonance_share": sign}, least, "resonance_share")
                  for sign, least in ((1.0, LEAST_SHARE), (-1.0, LEAST_SHARE - 1.0))]  # fmt: skip
    if "stribeck" in names:
        sides = dict.fromkeys(dry if dry in names else "Cd" for dry in ("coulomb_positive", "coulomb_negative"))
        found += [ParameterBound({side: 1.0, "stribeck": 1.0}, 0.0, "stribeck") for side in sides]
    return found
