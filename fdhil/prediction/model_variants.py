"""Derives variants of a model: without dry friction, linear, with averaged friction; and groups its terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fdhil.model import compute_friction_torque
from fdhil.records import PARAMETERS, Bool, Float, Parameters

DRY = ("coulomb_positive", "coulomb_negative", "stribeck", "stribeck_speed", "presliding_um")
LINEAR = ("resonance", "resonance_damping", "resonance_share")
# suffixes of a term's second and third value, which have no meaning alone
_PARTS = ("_phase", "_speed", "_damping", "_share")


def list_values(parameters: Parameters) -> dict[str, float]:
    """Return the six and the terms by name, in the order of a covariance."""
    return {**parameters.as_dict(), **dict(parameters.terms)}


def remove_dry_friction(parameters: Parameters) -> Parameters:
    """Return the model of the same drive without any dry friction."""
    return replace(parameters, Cd=0.0, terms=tuple(pair for pair in parameters.terms if pair[0] not in DRY))


def linearise_model(parameters: Parameters, dry_nm: float = 0.0) -> Parameters:
    """Return the linear part of a model with another dry friction: without any it is a linear system.

    A load, ripples and a dead time shift the operating point, not the response to an offset.
    """
    mean = average_friction(parameters)
    return replace(mean, Cd=dry_nm, terms=tuple(pair for pair in mean.terms if pair[0] in LINEAR))


def average_friction(parameters: Parameters) -> Parameters:
    """Return the six with friction averaged over both directions, and the terms other than friction."""
    p = parameters
    viscous = 0.5 * (p.get_term("viscous_positive", p.ft) + p.get_term("viscous_negative", p.ft))
    dry = 0.5 * (p.get_term("coulomb_positive", p.Cd) + p.get_term("coulomb_negative", p.Cd))
    left = tuple(pair for pair in p.terms if pair[0] not in (*DRY, "viscous_positive", "viscous_negative"))
    return replace(p, ft=viscous, Cd=dry, terms=left)


class FrictionBand(NamedTuple):
    """The motor torques, N.m, between which dry friction holds the shaft."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """The middle of the band, farthest from breaking loose."""
        return 0.5 * (self.low + self.high)

    def is_holding(self, torque_nm: Float, share: float) -> Bool:
        """Return (n,) whether torques lie in the inner ``share`` of the band."""
        return np.asarray(np.abs(torque_nm - self.middle) <= share * 0.5 * (self.high - self.low))


def compute_friction_band(parameters: Parameters, angle_rad: float) -> FrictionBand:
    """Return the band of a shaft that rests at an angle."""
    p = parameters
    pull = float(compute_friction_torque(p, np.zeros(1), np.array([angle_rad]))[0])
    low, high = (p.get_term(f"coulomb_{side}", p.Cd) + p.get_term("stribeck") for side in ("negative", "positive"))
    return FrictionBand(pull - low, pull + high)


def split_resisting_torque(parameters: Parameters, speed_rad_s: Float, angle_rad: Float) -> tuple[Float, Float]:
    """Return the torque (n,) against the positive direction of a turning shaft: its smooth and its dry part."""
    dry = replace(parameters, ft=0.0, terms=tuple(pair for pair in parameters.terms if pair[0] in DRY))
    models = remove_dry_friction(parameters), dry
    smooth_nm, dry_nm = (compute_friction_torque(model, speed_rad_s, angle_rad) for model in models)
    return smooth_nm, dry_nm


def get_main_term(name: str) -> str:
    """Return the term that a name belongs to: a ripple's phase to the ripple.

    >>> get_main_term("ripple_screw_1_phase"), get_main_term("stribeck_speed"), get_main_term("Jt")
    ('ripple_screw_1', 'stribeck', 'Jt')
    """
    return next((name.removesuffix(part) for part in _PARTS if name.endswith(part)), name)


def group_term_parts(names: Sequence[str]) -> Mapping[str, tuple[str, ...]]:
    """Return the names that belong together, by their main name."""
    found: dict[str, tuple[str, ...]] = {}
    for name in names:
        main = get_main_term(name)
        found[main] = (*found.get(main, ()), name)
    return found


def restore_earlier_values(now: Parameters, earlier: Parameters, names: Sequence[str]) -> Parameters:
    """Return the current model with earlier values of some names; a term that one of them lacks is zero there."""
    before, present = list_values(earlier), list_values(now)
    changed = {}
    for name in names:
        part = get_main_term(name) != name
        changed[name] = before.get(name, present.get(name, 0.0) if part else 0.0)
    return now.replace_values(**changed)


def collect_term_names(*models: Parameters) -> tuple[str, ...]:
    """Return the six and every term that any of the models has."""
    return tuple(dict.fromkeys((*PARAMETERS, *(name for model in models for name, _ in model.terms))))
