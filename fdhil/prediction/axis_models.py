"""Reads model files: the parameters of each axis as JSON, ``{"X": {"R", "L", "K", "Jt", "ft", "Cd"}, ...}``.

An axis may have three more tables: ``terms``, the value of each additional term; ``loops``, identified keys of
``[axis.X.regulators]`` that replace the configuration's; ``held_out``, the model's residual of moves that it was not
identified on.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdhil import config as configuration
from fdhil.config import MachineConfig, Regulators
from fdhil.errors import ConfigError, ConfigFault
from fdhil.identification import find_significant_violations, project_to_bounds
from fdhil.model import ABOVE_ZERO, LEAST_SHARE, NOT_NEGATIVE, add_resonance, list_bounds
from fdhil.prediction.model_variants import group_term_parts, list_values
from fdhil.records import PARAMETERS, UNITS, Parameters, ParameterSet, Trajectory, get_unit

MAX_BYTES = 64 * 1024
SHOWN_CHARS = 40
MOST_FAULTS = 50
LARGEST, SMALLEST = 1e12, 1e-12
COPIED = 1e-3  # tolerance of a value copied from fdhil's output
_TABLES = ("terms", "loops", "held_out")
TERMS = ("load", "coulomb_positive", "coulomb_negative", "viscous_positive", "viscous_negative", "stribeck",
         "stribeck_speed", "presliding_um", "ripple_screw_1", "ripple_screw_1_phase", "ripple_motor_1",
         "ripple_motor_1_phase", "dead_time", "speed_delay",
         "resonance", "resonance_damping", "resonance_share")  # fmt: skip
"""The terms' names, of the ripples the first ones."""

Loops = Mapping[str, Mapping[str, float | str]]
"""Per axis keys of its regulators."""


class ModelFile(NamedTuple):
    """The contents of a model file by axis; an axis without a table of loops has none in ``loops``.

    ``held_out_um`` is the model's RMS residual, um, of moves that it was not identified on, and
    ``find_held_out_max_um`` the largest error in any of them, where they are given.
    """

    parameters: dict[str, Parameters]
    loops: Loops
    held_out_um: Mapping[str, float]
    held_out_max_um: Mapping[str, float]


def build_nominal_models(config: MachineConfig) -> dict[str, Parameters]:
    """Return the data sheet's parameters of every axis."""
    return {name: Parameters(**axis.nominal.model_dump()) for name, axis in config.axis.items()}


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of JSON; ValueError for a repeated name, of which one would be ignored silently."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"{max(found, key=[name for name, _ in pairs].count)[:SHOWN_CHARS]!r} appears twice")
    return found


def load_model_file(path: Path) -> ModelFile:
    """Read a model file; ConfigError with all its faults: missing or unknown keys, invalid numbers, negative values."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise _build_file_error(path, f"cannot be read: {error.strerror}", "check the path") from None
    if len(raw) > MAX_BYTES:
        raise _build_file_error(path, "is larger than 64 KiB", "a model file has six numbers per axis")
    try:
        document = json.loads(raw.decode("utf-8"), object_pairs_hook=_reject_duplicate_keys)
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise _build_file_error(
            path, f"is no model file: {str(error)[:120]}", "fdhil identify --json gives the values"
        ) from None
    if not isinstance(document, dict) or not document:
        raise _build_file_error(
            path, "holds no axis", 'write {"X": {"R": .., "L": .., "K": .., "Jt": .., "ft": .., "Cd": ..}}'
        )
    faults: list[ConfigFault] = []
    models = {axis: _parse_parameters(axis[:SHOWN_CHARS], values, faults) for axis, values in document.items()}
    loops = {axis: _parse_table(axis[:SHOWN_CHARS], "loops", values, faults) for axis, values in document.items()}
    held_out = [
        {
            axis: um
            for axis, values in document.items()
            if (um := _parse_held_out_um(axis, key, values, faults)) is not None
        }
        for key in ("rms_um", "max_um")
    ]
    if faults:
        raise ConfigError(str(path), faults[:MOST_FAULTS])
    known = {axis: model for axis, model in models.items() if model is not None}
    return ModelFile(known, {axis: values for axis, values in loops.items() if "loops" in document[axis]}, *held_out)


def apply_loops(config: MachineConfig, loops: Loops, source: str) -> MachineConfig:
    """Return the configuration with keys of the regulators changed; ConfigError with their faults."""
    known = {axis: values for axis, values in loops.items() if axis in config.axis}
    if not known:
        return config
    document = config.model_dump(mode="json")
    for axis, values in known.items():
        document["axis"][axis]["regulators"] |= values
    return configuration.parse_config(document, source, made_up=True)


def load_validated_models(
    sets: Mapping[str, ParameterSet], config: MachineConfig, source: str
) -> tuple[dict[str, Parameters], MachineConfig]:
    """Return the model of each published set, and the configuration with the loops that they were validated with.

    ConfigError if a drive showed other loops than those configured, and the configuration has been changed since:
    neither is known to be the drive's. The same for a set with unphysical values.
    """
    faults: list[ConfigFault] = []
    models = {axis: _check_physical_model(axis, published, faults) for axis, published in sets.items()}
    loops = {}
    for axis, published in sets.items():
        if axis not in config.axis or not published.loops:
            continue
        if published.config_digest == config.digest:
            loops[axis] = published.loops
        elif apart := describe_loop_differences(published.loops, config.axis[axis].regulators):
            text = f"LoopsDiffer: the rapids showed other loops ({apart}), and the configuration has been changed since"
            advice = "enter the loops that the rapids showed, or run a few rapids with this configuration"
            faults.append(ConfigFault(f"axis.{axis}.regulators", text, advice))
    if faults:
        raise ConfigError(source, faults)
    return models, apply_loops(config, loops, source)


def describe_loop_differences(loops: Mapping[str, float | str], regulators: Regulators) -> str:
    """Return the differences between loops that rapids showed and the configured regulators, as text; empty: none."""
    pairs = [(key, shown, getattr(regulators, key)) for key, shown in loops.items()]
    apart = [(key, shown, has) for key, shown, has in pairs if not _is_same_value(has, shown)]
    return ", ".join(f"{key} {_format_value(shown)} instead of {_format_value(has)}" for key, shown, has in apart)


def _format_value(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def _is_same_value(configured: float | str, shown: float | str) -> bool:
    if isinstance(configured, str) or isinstance(shown, str):
        return configured == shown
    return math.isclose(configured, shown, rel_tol=COPIED, abs_tol=1e-6)


def _check_physical_model(axis: str, published: ParameterSet, faults: list[ConfigFault]) -> Parameters:
    """Return the parameters of a set, moved into the physical bounds that an earlier fdhil exceeded by chance."""
    by_name, covariance = list_values(published.parameters), published.covariance
    names, values = tuple(by_name), np.array([*by_name.values()])
    if all(bound.compute_violation(by_name) <= 0.0 for bound in list_bounds(names)):
        return published.parameters
    if covariance.shape != (len(names), len(names)) or find_significant_violations(names, values, covariance):
        text = "Unphysical: friction in the newest set would drive the axis, or a value must not be negative"
        faults.append(ConfigFault(axis, text, "record rapids in both directions, and identify the axis again"))
        return published.parameters
    return Parameters.from_mapping(dict(zip(names, project_to_bounds(names, values, covariance).tolist(), strict=True)))


def _build_file_error(path: Path, what: str, suggestion: str) -> ConfigError:
    return ConfigError(str(path), [ConfigFault("model", what, suggestion)])


def _parse_parameters(axis: str, values: Any, faults: list[ConfigFault]) -> Parameters | None:
    if not isinstance(values, dict):
        faults.append(ConfigFault(axis, "holds no parameters", f"it needs {', '.join(PARAMETERS)}"))
        return None
    before = len(faults)
    for name in PARAMETERS:
        if name not in values:
            faults.append(ConfigFault(f"{axis}.{name}", "is missing", f"in {UNITS[name]}"))
        elif fault := _check_value(name, values[name]):
            faults.append(ConfigFault(f"{axis}.{name}", fault, f"in {UNITS[name]}"))
    known = (*PARAMETERS, *_TABLES)
    faults += [
        _build_unknown_name_fault(axis, name, known, "the parameters are") for name in sorted(set(values) - {*known})
    ]
    terms = _parse_table(axis, "terms", values, faults)
    faults += _check_terms(axis, terms, values.get("Cd"))
    if len(faults) > before:
        return None
    return Parameters.from_mapping({**{name: values[name] for name in PARAMETERS}, **terms})


def _parse_table(axis: str, name: str, values: Any, faults: list[ConfigFault]) -> dict[str, Any]:
    table = values.get(name, {}) if isinstance(values, dict) else {}
    if not isinstance(table, dict):
        faults.append(ConfigFault(f"{axis}.{name}", f"must be a table of names, not {_truncate_value(table)}"))
        return {}
    return table


def _parse_held_out_um(axis: str, key: str, values: Any, faults: list[ConfigFault]) -> float | None:
    table = _parse_table(axis[:SHOWN_CHARS], "held_out", values, faults if key == "rms_um" else [])
    if not table or (key != "rms_um" and key not in table):
        return None
    um = table.get(key)
    if isinstance(um, bool) or not isinstance(um, int | float) or not 0.0 <= um <= LARGEST:
        place = f"{axis[:SHOWN_CHARS]}.held_out.{key}"
        faults.append(ConfigFault(place, f"must be a finite number of at least 0, not {_truncate_value(um)}", "in um"))
        return None
    return float(um)


def _build_unknown_name_fault(axis: str, name: str, known: tuple[str, ...], listed: str) -> ConfigFault:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}?" if near else f"{listed} {', '.join(known)}"
    return ConfigFault(f"{axis}.{name[:SHOWN_CHARS]}", "is not a parameter", hint)


def _check_terms(axis: str, terms: Mapping[str, Any], dry_nm: Any) -> list[ConfigFault]:
    place, faults = f"{axis}.terms", []
    for name, value in terms.items():
        if name in PARAMETERS or get_unit(name) is None:
            faults.append(_build_unknown_name_fault(place, name, TERMS, "terms are"))
        elif fault := _check_value(name, value):
            faults.append(ConfigFault(f"{place}.{name}", fault, f"in {get_unit(name)}"))
    for main, (name, *_) in group_term_parts(tuple(terms)).items():
        if main not in terms:
            text = f"has no meaning without {main[:SHOWN_CHARS]}"
            faults.append(ConfigFault(f"{place}.{name[:SHOWN_CHARS]}", text))
    if "stribeck" in terms and "stribeck_speed" not in terms:
        faults.append(ConfigFault(f"{place}.stribeck", "requires stribeck_speed", "in rad/s"))
    if not faults and "stribeck" in terms and _check_value("Cd", dry_nm) is None:
        friction = {"Cd": dry_nm, **terms}
        if any(
            bound.compute_violation(friction) > 0.0 for bound in list_bounds(tuple(friction)) if len(bound.weights) > 1
        ):
            text = "exceeds the dry friction: at standstill friction would be below 0"
            faults.append(ConfigFault(f"{place}.stribeck", text, "in N.m"))
    return faults


def _check_value(name: str, value: Any) -> str | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"must be a number, not {_truncate_value(value)}"
    if abs(value) > LARGEST or not math.isfinite(value) or 0 < abs(value) < SMALLEST:
        return f"must be a finite number of this physical quantity, not {_truncate_value(value)}"
    if name in ABOVE_ZERO and value <= 0:
        return f"must be above 0, not {_truncate_value(value)}"
    if name in NOT_NEGATIVE and value < 0:
        return f"must be at least 0, not {_truncate_value(value)}"
    if name == "resonance_share" and not LEAST_SHARE <= value <= 1 - LEAST_SHARE:
        return f"must be from {LEAST_SHARE} to {1 - LEAST_SHARE}, not {_truncate_value(value)}"
    return None


def _truncate_value(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN_CHARS else f"{text[:SHOWN_CHARS]}..."


def select_models(
    reference: Trajectory, given: Mapping[str, Parameters], config: MachineConfig, source: str
) -> dict[str, Parameters]:
    """Return a model for every axis of the reference; an axis at rest may lack one and gets the nominal.

    A model without a resonance gets the configured one. ConfigError if an axis that moves has no model.
    """
    nominal = build_nominal_models(config)
    faults = [
        ConfigFault(axis, "moves and has no model", "identify it, or omit the option to use the nominal values")
        for axis in reference.axes
        if axis not in given and np.ptp(reference.position_mm[axis]) > 0.0
    ]
    if faults:
        raise ConfigError(source, faults)
    return {axis: add_resonance(given.get(axis, nominal[axis]), config.axis[axis]) for axis in reference.axes}
