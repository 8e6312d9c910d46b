"""Checks that the database's views can show a record: no machine can break the views for all."""

from collections.abc import Mapping
from typing import Any

from fdhil.records import PARAMETERS

MOST_ROWS = 100  # of a covariance
COUNTS: Mapping[str, Mapping[str, int]] = {  # with the limit of the views' type
    "parameters": {"revision": 1 << 53, "windows": 1 << 53},
    "window": {"number": 1 << 53, "accepted": 1, "direction": 1},
    "notice": {"number": 1 << 53},
    "offer": {"version": 1 << 30, "stage": 1 << 30},
}
MEASURES: Mapping[str, tuple[str, ...]] = {
    "parameters": (*PARAMETERS, "temperature_c"),
    "window": ("fit_percent", "temperature_c", "unexplained_um"),
    "skill": ("rms_um", "max_um", "delay_ms", "measured_rms_um"),
}


def find_fault(kind: str, record: Mapping[str, Any]) -> str:
    """Return why a record of a kind is invalid; empty: it is valid."""
    for name, largest in COUNTS.get(kind, {}).items():
        if record.get(name) is not None and not _is_count(record[name], largest):
            return f"its {name} is not a valid whole number"
    for name in MEASURES.get(kind, ()):
        if not _is_measure(record.get(name)):
            return f"its {name} is not a number"
    if kind == "parameters" and not _is_matrix(record.get("covariance", [])):
        return "its covariance is not a square matrix of numbers"
    if kind == "acknowledgement":
        notices = record.get("notices", [])
        return "" if isinstance(notices, list) and all(map(_is_count, notices)) else "its notices are not numbers"
    return _find_about_fault(record) if kind == "about" else ""


def _is_count(value: object, largest: int = 1 << 53) -> bool:
    return type(value) is int and -largest <= value <= largest


def _is_measure(value: object) -> bool:
    return value is None or isinstance(value, float) or _is_count(value)


def _is_matrix(value: Any) -> bool:
    rows = isinstance(value, list) and len(value) <= MOST_ROWS
    return rows and all(
        isinstance(row, list) and len(row) == len(value) and all(map(_is_measure, row)) for row in value
    )


def _find_about_fault(record: Mapping[str, Any]) -> str:
    labels, of_axes = record.get("labels", {}), record.get("axis_labels", {})
    if not isinstance(of_axes, dict) or not all(map(_is_label_map, (labels, *of_axes.values()))):
        return "its labels are not texts"
    return "" if isinstance(record.get("name", ""), str) else "its name is not a text"


def _is_label_map(labels: object) -> bool:
    return isinstance(labels, dict) and all(isinstance(text, str) for text in labels.values())
