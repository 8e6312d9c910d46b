"""States what a feed drive can physically be: the one rule of fits, verdicts, model files and predictions.

Friction never pushes: its dry part is at least 0 in either direction, at rest as well as at speed, and so is its
viscous part. What is divided by is above 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

ABOVE_ZERO = ("R", "L", "K", "Jt", "stribeck_speed", "resonance")
NOT_NEGATIVE = ("ft", "Cd", "coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative",
                "resonance_damping", "presliding_um")  # fmt: skip
LEAST_SHARE = 0.01  # of the inertia before and behind a spring: with less there is no second mass
LEAST_SPEED_RAD_S = 1e-3  # at which friction at low speed falls off: slower than any sample tells


@dataclass(frozen=True, slots=True)
class Bound:
    """A weighted sum of named values that is at least ``least``; ``moves`` is the value that gives way."""

    weights: Mapping[str, float]
    least: float
    moves: str

    def beyond(self, values: Mapping[str, float]) -> float:
        """Return by how much the values lie beyond the bound; 0 or less is within it."""
        return self.least - sum(weight * values[name] for name, weight in self.weights.items())


def bounds(names: Sequence[str]) -> list[Bound]:
    """Return the bounds of a model that has these parameters and terms, but for those of R, L, K and Jt."""
    found = [Bound({name: 1.0}, 0.0, name) for name in NOT_NEGATIVE if name in names]
    if "stribeck_speed" in names:
        found.append(Bound({"stribeck_speed": 1.0}, LEAST_SPEED_RAD_S, "stribeck_speed"))
    if "resonance_share" in names:
        found += [Bound({"resonance_share": sign}, least, "resonance_share")
                  for sign, least in ((1.0, LEAST_SHARE), (-1.0, LEAST_SHARE - 1.0))]  # fmt: skip
    if "stribeck" in names:
        sides = dict.fromkeys(dry if dry in names else "Cd" for dry in ("coulomb_positive", "coulomb_negative"))
        found += [Bound({side: 1.0, "stribeck": 1.0}, 0.0, "stribeck") for side in sides]
    return found
