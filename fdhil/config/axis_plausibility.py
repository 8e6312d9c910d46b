"""Checks that the numbers of an axis fit one machine, and identifies a key that was typed in the wrong unit.

Each relation between keys has an ordinary range, wide enough for usual feed drives, and a possible range, beyond which
no drive exists. Outside the possible range the configuration is refused; outside the ordinary one it is used with a
warning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter

from fdhil.config.axis_section import Axis

Numbers = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Relation:
    """A figure derived from some ``keys``: its description, its ordinary range, and its possible range."""

    keys: tuple[str, ...]
    text: str
    unit: str
    figure: Callable[[Numbers], float]
    ordinary: tuple[float, float]
    possible: tuple[float, float]


@dataclass(frozen=True, slots=True)
class UnitMistake:
    """A unit in which a key is often typed by mistake: ``factor`` converts the number to the key's own unit."""

    key: str
    factor: float
    unit: str


@dataclass(frozen=True, slots=True)
class Implausibility:
    """An impossible or unlikely figure of an axis; ``key`` is the one to check first."""

    key: str
    text: str
    possible: bool


RELATIONS = (
    Relation(("nominal.L", "nominal.R"), "the windings' time constant L/R", "s",
             lambda n: n["nominal.L"] / n["nominal.R"], (1e-4, 0.1), (1e-5, 1.0)),
    Relation(("rapid_speed_mm_s", "screw_pitch_mm"), "the motor's speed in a rapid", "1/min",
             lambda n: 60.0 * n["rapid_speed_mm_s"] / n["screw_pitch_mm"], (10.0, 15e3), (0.5, 1e5)),
    Relation(("rapid_speed_mm_s", "max_acceleration_mm_s2"), "the time to reach the rapid speed", "s",
             lambda n: n["rapid_speed_mm_s"] / n["max_acceleration_mm_s2"], (2e-3, 10.0), (1e-4, 60.0)),
    Relation(("nominal.K", "rapid_speed_mm_s", "screw_pitch_mm", "regulators.voltage_limit_v"),
             "the back-EMF in a rapid, as a share of voltage_limit_v,", "",
             lambda n: n["nominal.K"] * _compute_speed_rad_s(n) / n["regulators.voltage_limit_v"],
             (1e-3, 1.5), (1e-5, 5.0)),
    Relation(("nominal.Jt", "max_acceleration_mm_s2", "nominal.K", "screw_pitch_mm", "regulators.current_limit_a"),
             "the current for max_acceleration_mm_s2, as a share of current_limit_a,", "",
             lambda n: n["nominal.Jt"] * _compute_acceleration_rad_s2(n) / _compute_torque_nm(n),
             (2e-3, 2.0), (1e-6, 20.0)),
    Relation(("nominal.Cd", "nominal.K", "regulators.current_limit_a"),
             "the current against dry friction, as a share of current_limit_a,", "",
             lambda n: n["nominal.Cd"] / _compute_torque_nm(n), (0.0, 0.8), (0.0, 1.0)),
    Relation(("nominal.ft", "nominal.K", "rapid_speed_mm_s", "screw_pitch_mm", "regulators.current_limit_a"),
             "the current against viscous friction in a rapid, as a share of current_limit_a,", "",
             lambda n: n["nominal.ft"] * _compute_speed_rad_s(n) / _compute_torque_nm(n), (0.0, 0.8), (0.0, 1.0)),
    Relation(("nominal.R", "regulators.current_limit_a", "regulators.voltage_limit_v"),
             "the voltage that drives current_limit_a through R, as a share of voltage_limit_v,", "",
             lambda n: n["nominal.R"] * n["regulators.current_limit_a"] / n["regulators.voltage_limit_v"],
             (1e-4, 5.0), (1e-6, 50.0)),
)  # fmt: skip
SLIPS = (  # most frequent first
    UnitMistake("nominal.L", 1e-3, "mH"),
    UnitMistake("nominal.L", 1e-6, "uH"),
    UnitMistake("nominal.R", 1e-3, "mohm"),
    UnitMistake("nominal.K", 60e-3 / (2 * math.pi), "V/krpm"),
    UnitMistake("nominal.K", 1e-3, "mN.m/A"),
    UnitMistake("screw_pitch_mm", 1e3, "m"),
    UnitMistake("max_acceleration_mm_s2", 1e3, "m/s2"),
    UnitMistake("rapid_speed_mm_s", 1e3, "m/s"),
    UnitMistake("rapid_speed_mm_s", 1 / 60, "mm/min"),
    UnitMistake("nominal.Jt", 1e-3, "g.m2"),
    UnitMistake("nominal.Jt", 1e-4, "kg.cm2"),
    UnitMistake("nominal.Jt", 1e-6, "kg.mm2"),
    UnitMistake("nominal.Cd", 1e-2, "N.cm"),
    UnitMistake("nominal.Cd", 1e-3, "mN.m"),
    UnitMistake("nominal.ft", 1e-3, "mN.m.s"),
)
MOST_NAMED = 2


def find_implausibilities(axis: Axis) -> list[Implausibility]:
    """Return what is implausible about an axis' numbers, the impossible first; empty for an ordinary machine."""
    numbers = _collect_numbers(axis)
    broken = [relation for relation in RELATIONS if not _is_within(relation.figure(numbers), relation.ordinary)]
    if not broken:
        return []
    slips = [slip for slip in SLIPS if axis.format_key(slip.key) == slip.key]  # angles are not confused with lengths
    mistakes = [slip for slip in slips if _is_explanation(slip, numbers, broken)]
    found = [_describe_implausibility(axis, relation, numbers, mistakes) for relation in broken]
    found.sort(key=lambda doubt: doubt.possible)
    return found[:1] if mistakes else found  # one wrong unit breaks many relations


def _describe_implausibility(
    axis: Axis, relation: Relation, numbers: Numbers, mistakes: list[UnitMistake]
) -> Implausibility:
    figure = relation.figure(numbers)
    possible = _is_within(figure, relation.possible)
    low, high = relation.ordinary
    bounds = f"{low:g} to {high:g}" if low > 0 else f"at most {high:g}"
    text = f"{_list_numbers(axis, relation, numbers)}: {relation.text} is {figure:.3g}{_format_unit(relation.unit)}, "
    text += f"feed drives have {bounds}{_format_unit(relation.unit)}"
    guesses = [f"{slip.key} = {numbers[slip.key] * slip.factor:.4g} ({numbers[slip.key]:g} {slip.unit})"
               for slip in mistakes[:MOST_NAMED]]  # fmt: skip
    text += f"; did you mean {' or '.join(guesses)}?" if guesses else "; check the units of these keys"
    return Implausibility(axis.format_key(mistakes[0].key if mistakes else relation.keys[0]), text, possible)


def _list_numbers(axis: Axis, relation: Relation, numbers: Numbers) -> str:
    shown = {key: axis.format_key(key) for key in relation.keys}
    factor = {key: 1.0 if shown[key] == key else axis.mm_per_unit for key in relation.keys}
    return ", ".join(f"{shown[key].rpartition('.')[2]} = {numbers[key] / factor[key]:g}" for key in relation.keys)


def _format_unit(unit: str) -> str:
    return f" {unit}" if unit else ""


def _is_explanation(slip: UnitMistake, numbers: Numbers, broken: list[Relation]) -> bool:
    if not all(slip.key in relation.keys for relation in broken):
        return False
    tried = {**numbers, slip.key: numbers[slip.key] * slip.factor}
    return all(_is_within(relation.figure(tried), relation.ordinary) for relation in RELATIONS)


def _is_within(figure: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] <= figure <= bounds[1]


def _collect_numbers(axis: Axis) -> dict[str, float]:
    return {key: attrgetter(key)(axis) for relation in RELATIONS for key in relation.keys}


def _compute_speed_rad_s(numbers: Numbers) -> float:
    return numbers["rapid_speed_mm_s"] / numbers["screw_pitch_mm"] * 2 * math.pi


def _compute_acceleration_rad_s2(numbers: Numbers) -> float:
    return numbers["max_acceleration_mm_s2"] / numbers["screw_pitch_mm"] * 2 * math.pi


def _compute_torque_nm(numbers: Numbers) -> float:
    return numbers["nominal.K"] * numbers["regulators.current_limit_a"]
