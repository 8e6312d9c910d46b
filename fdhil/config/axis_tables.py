"""Completes the [axis.*] tables of a document: angles become lengths at the radius, a second drive inherits keys.

A rotary axis (``unit = "deg"``) is written in degrees: each key has ``deg`` where the models have ``mm``, and may have
``mdeg`` where they have ``um``. It is then treated as a linear axis of the rim at ``radius_mm``: 1 degree is pi / 180
radius_mm. [axis.Y2] is the second drive of the gantry axis Y and inherits the keys of [axis.Y] that it does not set.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from fdhil.config.section import LARGEST, is_second_drive
from fdhil.errors import ConfigFault

_OWN_SENSORS = ("table", "accelerometer", "temperature", "voltage")
_OF_THE_TABLE_ENCODER = ("scale", "offset")


def compute_mm_per_degree(radius_mm: float) -> float:
    """Return the length of arc of one degree at a radius, mm."""
    return math.radians(radius_mm)


def convert_key_to_degrees(key: str) -> str:
    """Convert a model's key to that of a rotary axis: ``rapid_speed_mm_s`` to ``rapid_speed_deg_s``."""
    return key if key == "radius_mm" else key.replace("_mm", "_deg")


def convert_key_to_mm(key: str) -> str:
    """Convert a key of a rotary axis to that of the models; 1 mdeg is as many um as 1 deg is mm."""
    return key.replace("_mdeg", "_um").replace("_deg", "_mm")


def find_rotary_axes(document: Mapping[str, Any]) -> dict[str, float]:
    """Return mm per degree of each axis written in degrees; 1 where its radius is invalid."""
    axes = {name: _get_table(axis) for name, axis in _get_table(document.get("axis")).items()}
    rotary = {name: axis for name, axis in axes.items() if axis.get("unit") == "deg" or any("_deg" in k for k in axis)}
    radii = {name: axis.get("radius_mm") for name, axis in rotary.items()}
    return {
        name: compute_mm_per_degree(float(r)) if r is not None and _is_number(r) and r > 0 else 1.0
        for name, r in radii.items()
    }


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def complete_axis_tables(document: Mapping[str, Any], faults: list[ConfigFault]) -> dict[str, Any]:
    """Return the document as the models need it; invalid units are added to ``faults``."""
    axes = {**_get_table(document.get("axis"))}
    for name in filter(is_second_drive, [*axes]):
        first = axes.get(name[0])
        if first is None:
            text = f"is the second drive of axis {name[0]}, which is missing"
            faults.append(ConfigFault(f"axis.{name}", text, f"add [axis.{name[0]}], or rename this section"))
            del axes[name]
        elif isinstance(first, Mapping) and isinstance(axes[name], Mapping):
            faults += _find_sensor_faults(name, first, axes[name])
            axes[name] = _inherit_keys(first, axes[name])
    found: dict[str, Any] = {**document}
    if axes:
        found["axis"] = axes
    for name, factor in find_rotary_axes(found).items():
        if axes[name].get("unit", "mm") == "mm":
            faults.append(ConfigFault(f"axis.{name}.unit", 'is "mm", and keys are in degrees', 'give unit = "deg"'))
        found["axis"][name] = _convert_to_lengths(axes[name], factor, f"axis.{name}", faults)
        simulated = _get_table(_get_table(document.get("sim")).get("axis"))
        if name in simulated:
            part = _convert_to_lengths(simulated[name], factor, f"sim.axis.{name}", faults)
            found["sim"] = {**found["sim"], "axis": {**found["sim"]["axis"], name: part}}
    return found


def _get_table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _inherit_keys(first: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    taken = {key: value for key, value in first.items() if key not in _OWN_SENSORS}
    for key, value in own.items():
        below = taken.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            value = {**{k: v for k, v in below.items() if k != "node_id"}, **value}
        taken[key] = value
    if "drive" not in own and isinstance(taken.get("drive"), Mapping):
        taken["drive"] = {key: value for key, value in taken["drive"].items() if key != "node_id"}
    return taken


def _find_sensor_faults(name: str, first: Mapping[str, Any], own: Mapping[str, Any]) -> Iterator[ConfigFault]:
    if _get_table(first.get("voltage")).get("source", "drive") != "drive" and "voltage" not in own:
        text = f"is missing: the sensor of [axis.{name[:1]}.voltage] measures the other motor"
        yield ConfigFault(f"axis.{name}.voltage", text, 'give its own sensor, or source = "drive"')


def _convert_to_lengths(table: Any, factor: float, path: str, faults: list[ConfigFault]) -> Any:
    if not isinstance(table, Mapping):
        return table
    found: dict[str, Any] = {}
    for key, value in table.items():
        name = convert_key_to_mm(key)
        if isinstance(value, Mapping):
            found[key] = _convert_to_lengths(value, factor, f"{path}.{key}", faults)
        elif name == key:
            if "_mm" in key and key != "radius_mm":
                text = "is a length, and this axis is rotary"
                faults.append(ConfigFault(f"{path}.{key}", text, f"give {convert_key_to_degrees(key)}, in degrees"))
            encoder = path.endswith(".table") and key in _OF_THE_TABLE_ENCODER
            found[key] = _scale_numbers(value, factor) if encoder else value
        elif name in table:
            faults.append(ConfigFault(f"{path}.{key}", f"duplicates {name}", "keep one of them"))
        else:
            found[name] = _scale_numbers(value, factor)
    if path.endswith(".table"):
        found.setdefault("scale", 1e-3 * factor)
    return found


def _scale_numbers(value: Any, factor: float) -> Any:
    if isinstance(value, list | tuple):
        return [_scale_numbers(item, factor) for item in value]
    return value * factor if _is_number(value) else value
