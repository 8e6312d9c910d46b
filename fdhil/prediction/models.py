"""Reads model files: the six parameters of each axis as JSON, ``{"X": {"R", "L", "K", "Jt", "ft", "Cd"}, ...}``."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import PARAMETERS, UNITS, Parameters, Trajectory

MAX_BYTES = 64 * 1024
SHOWN_CHARS = 40
MOST_FAULTS = 50
LARGEST, SMALLEST = 1e12, 1e-12
_MAY_BE_ZERO = ("ft", "Cd")


def nominal_models(config: MachineConfig) -> dict[str, Parameters]:
    """Return the data sheet's parameters of every axis."""
    return {name: Parameters(**axis.nominal.model_dump()) for name, axis in config.axis.items()}


def load_models(path: Path) -> dict[str, Parameters]:
    """Read a model file; ConfigError with all its faults: missing or unknown keys, no numbers, negative values."""
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise _cannot(path, f"cannot be read: {error.strerror}", "check the path") from None
    if len(raw) > MAX_BYTES:
        raise _cannot(path, "is larger than 64 KiB", "a model file has six numbers per axis")
    try:
        document = json.loads(raw.decode("utf-8"))
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise _cannot(path, f"is no JSON: {str(error)[:120]}", "fdhil identify --json gives the values") from None
    if not isinstance(document, dict) or not document:
        raise _cannot(path, "holds no axis", 'write {"X": {"R": .., "L": .., "K": .., "Jt": .., "ft": .., "Cd": ..}}')
    faults: list[ConfigFault] = []
    models = {axis: _parameters(axis[:SHOWN_CHARS], values, faults) for axis, values in document.items()}
    if faults:
        raise ConfigError(str(path), faults[:MOST_FAULTS])
    return {axis: model for axis, model in models.items() if model is not None}


def _cannot(path: Path, what: str, suggestion: str) -> ConfigError:
    return ConfigError(str(path), [ConfigFault("model", what, suggestion)])


def _parameters(axis: str, values: Any, faults: list[ConfigFault]) -> Parameters | None:
    if not isinstance(values, dict):
        faults.append(ConfigFault(axis, "holds no parameters", f"it needs {', '.join(PARAMETERS)}"))
        return None
    before = len(faults)
    for name in PARAMETERS:
        if name not in values:
            faults.append(ConfigFault(f"{axis}.{name}", "is missing", f"in {UNITS[name]}"))
        elif fault := _fault(name, values[name]):
            faults.append(ConfigFault(f"{axis}.{name}", fault, f"in {UNITS[name]}"))
    for name in set(values) - set(PARAMETERS):
        near = difflib.get_close_matches(name, PARAMETERS, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"the parameters are {', '.join(PARAMETERS)}"
        faults.append(ConfigFault(f"{axis}.{name[:SHOWN_CHARS]}", "is no parameter", hint))
    if len(faults) > before:
        return None
    return Parameters.of({name: values[name] for name in PARAMETERS})


def _fault(name: str, value: Any) -> str | None:
    """Say what is wrong with a value, None when nothing is."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"must be a number, not {_shown(value)}"
    if abs(value) > LARGEST or not math.isfinite(value) or 0 < abs(value) < SMALLEST:
        return f"must be a finite number of this physical quantity, not {_shown(value)}"
    if value < 0 or (value == 0 and name not in _MAY_BE_ZERO):
        return f"must be {'at least 0' if name in _MAY_BE_ZERO else 'above 0'}, not {_shown(value)}"
    return None


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN_CHARS else f"{text[:SHOWN_CHARS]}..."


def models_for(
    reference: Trajectory, given: Mapping[str, Parameters], config: MachineConfig, source: str
) -> dict[str, Parameters]:
    """Return a model for every axis of the reference; an axis that stands still may lack one and gets the nominal.

    ConfigError where an axis that moves has none.
    """
    nominal = nominal_models(config)
    faults = [
        ConfigFault(axis, "moves and has no model", "identify it, or leave the option out to use the nominal values")
        for axis in reference.axes
        if axis not in given and np.ptp(reference.position_mm[axis]) > 0.0
    ]
    if faults:
        raise ConfigError(source, faults)
    return {axis: given.get(axis, nominal[axis]) for axis in reference.axes}
