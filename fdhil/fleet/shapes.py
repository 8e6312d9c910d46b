"""What a record must be like so that the views of the database can show it: no machine can make them fail for all."""

from collections.abc import Mapping
from typing import Any

from fdhil.records import PARAMETERS

LARGEST = 1 << 62
COUNTS: Mapping[str, tuple[str, ...]] = {
    "parameters": ("revision", "windows"),
    "window": ("number", "accepted", "direction"),
    "notice": ("number",),
    "offer": ("version", "stage"),
}
MEASURES: Mapping[str, tuple[str, ...]] = {
    "parameters": (*PARAMETERS, "temperature_c"),
    "window": ("fit_percent", "temperature_c", "unexplained_um"),
    "skill": ("rms_um", "max_um", "delay_ms", "measured_rms_um"),
}


def fault(kind: str, record: Mapping[str, Any]) -> str:
    """Return what is wrong with a record of a kind; empty: nothing."""
    for name in COUNTS.get(kind, ()):
        if record.get(name) is not None and not _is_count(record[name]):
            return f"its {name} is no whole number"
    for name in MEASURES.get(kind, ()):
        value = record.get(name)
        if value is not None and not isinstance(value, float) and not _is_count(value):
            return f"its {name} is no number"
    if kind == "acknowledgement":
        notices = record.get("notices", [])
        return "" if isinstance(notices, list) and all(map(_is_count, notices)) else "its notices are no numbers"
    return _about_fault(record) if kind == "about" else ""


def _is_count(value: object) -> bool:
    return type(value) is int and -LARGEST < value < LARGEST


def _about_fault(record: Mapping[str, Any]) -> str:
    labels, of_axes = record.get("labels", {}), record.get("axis_labels", {})
    if not isinstance(of_axes, dict) or not all(map(_are_labels, (labels, *of_axes.values()))):
        return "its labels are no texts"
    return ""


def _are_labels(labels: object) -> bool:
    return isinstance(labels, dict) and all(isinstance(text, str) for text in labels.values())
