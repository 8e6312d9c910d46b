"""Formats parameters for display: one unit each, and ± as half the 95 % interval, in every table."""

import math
from collections.abc import Mapping
from typing import Any

from fdhil.records import UNITS

INTERVAL_MEANING = "± is half the width of the 95 % interval"
# displayed unit and factor; the ratios to K and all of JSON stay in SI units
DISPLAY_UNITS: Mapping[str, tuple[str, float]] = {name: (unit, 1.0) for name, unit in UNITS.items()} | {
    "R": ("mohm", 1e3),
    "L": ("mH", 1e3),
    "Jt": ("g.m2", 1e3),
    "ft": ("mN.m.s", 1e3),
}

PARAMETER_MEANINGS: Mapping[str, str] = {
    "R": "resistance of the winding",
    "L": "inductance of the winding",
    "K": "torque per ampere",
    "Jt": "inertia at the motor's shaft",
    "ft": "friction that grows with speed",
    "Cd": "dry friction",
    "friction_at_rapid": "friction at the rapid speed",
    "Jt/K": "inertia, in amperes",
    "ft/K": "friction that grows with speed, in amperes",
    "Cd/K": "dry friction, in amperes",
}


def format_minute(time: str) -> str:
    """Format a time of JSON (ISO 8601, UTC) to the minute, with its time zone.

    >>> format_minute("2026-11-28T01:15:09+00:00")
    '2026-11-28 01:15 UTC'
    """
    return f"{time[:16].replace('T', ' ')} UTC"


def describe_name(name: str) -> str:
    """Return a parameter's symbol, or its description if it has none."""
    return PARAMETER_MEANINGS[name] if "_" in name else name


def format_heading(name: str) -> str:
    """Return the heading of a parameter's column: its symbol above its unit."""
    return f"{name}\n{DISPLAY_UNITS[name][0]}"


def compute_half_width(interval: Mapping[str, Any]) -> float | None:
    """Return half the width of a 95 % interval in JSON; None without an interval."""
    if interval.get("low") is None or interval.get("high") is None:
        return None
    return float(interval["high"] - interval["low"]) / 2


def format_cell(name: str, value: float | None, half: float | None, between: str = "\n") -> str:
    """Format a value and half of its interval in the parameter's unit, both to the half's first digit."""
    if value is None or not math.isfinite(value):
        return "-"
    factor = DISPLAY_UNITS[name][1] if name in DISPLAY_UNITS else 1.0  # terms are displayed in SI units
    shown = value * factor
    if half is None or not math.isfinite(half):
        return f"{shown:.4g}{between}(no ±)"
    width = half * factor
    if width <= 0.0:
        return f"{shown:.6g}{between}±0"
    digits = -math.floor(math.log10(width))
    if -1 <= digits <= 6:
        places = max(0, digits)
        return f"{shown:.{places}f}{between}±{width:.{places}f}"
    if digits < 0 and abs(shown) < 1e6:
        return f"{round(shown, digits):.0f}{between}±{round(width, digits):.0f}"
    return _format_with_exponent(shown, width, between)


def _format_with_exponent(value: float, width: float, between: str) -> str:
    exponent = math.floor(math.log10(max(abs(value), width)))
    places = max(0, exponent - math.floor(math.log10(width)))
    scale = 10.0**exponent
    return f"({value / scale:.{places}f}{between}±{width / scale:.{places}f})e{exponent}"
