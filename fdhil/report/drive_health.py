"""Assesses the drives' health from stored windows: slopes, steps, and the dates of maintenance limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from fdhil.records import PARAMETERS, RATIOS, get_unit
from fdhil.report.parameter_format import DISPLAY_UNITS, compute_half_width, format_cell

if TYPE_CHECKING:
    from fdhil.config import MachineConfig
    from fdhil.identification import Crossing, Step
    from fdhil.records import Float
    from fdhil.store import History, StoredWindow

NEWEST_WINDOWS = 2000
DAY_S = 86_400.0
LEAST_SPAN_S = 3_600.0  # below it a trend is warming, not wear
WEAR_SPAN_S = 2 * DAY_S  # from it on temperature effects are distinguished from wear
FARTHEST_DAYS = 3_650.0
TOGETHER = 2  # windows within which steps have one cause
CAUSES = {
    frozenset({"Jt"}): "a changed load",
    frozenset({"ft"}): "changed lubrication",
    frozenset({"ft", "Cd"}): "changed lubrication or guides",
    frozenset({"Cd"}): "changed guides, seals or preload",
    frozenset({"R"}): "a changed winding or connection",
    frozenset({"K"}): "changed magnets or a current sensor's gain",
}


def assess_health(
    windows: Sequence[StoredWindow], history: History, machine: MachineConfig
) -> dict[str, dict[str, Any]]:
    """Return by axis ``slopes``, ``trends``, ``limits``, ``changes`` and their ``windows``, for JSON.

    ``windows`` are the newest of ``history``, oldest first. An axis without voltage has no accepted windows; its ratios
    to K still track friction and load.
    """
    stored = [window for window in windows if window.parameters]
    assessed = {}
    for name in dict.fromkeys(window.axis for window in stored):
        own = [window for window in stored if window.axis == name]
        accepted = [window for window in own if window.accepted]
        if not accepted:
            if ratios := [window for window in own if _has_ratios_only(window)]:
                assessed[name] = assess_axis_health(ratios, {}, RATIOS)
            continue
        first = history.read_first_revision(name)
        limits = {}
        if first is not None:
            shares = machine.maintenance.model_dump()
            limits = {symbol: (value, shares[symbol]) for symbol, value in first.set.parameters.as_dict().items()}
        assessed[name] = assess_axis_health(accepted, limits)
    return assessed


def _has_ratios_only(window: StoredWindow) -> bool:
    has_ratios = (window.parameters or {}).get(RATIOS[0], {}).get("value") is not None
    return has_ratios and len(window.reasons) == 1


def assess_axis_health(
    windows: Sequence[StoredWindow], limits: Mapping[str, tuple[float, float]], symbols: Sequence[str] = PARAMETERS
) -> dict[str, Any]:
    """Return an axis' health; ``limits`` maps a symbol to its first published value and its allowed relative change."""
    import numpy as np

    from fdhil.identification import BY_DIRECTION, FRICTION_AT_RAPID, find_steps, fit_slope, remove_direction_bias

    symbols = (*symbols, FRICTION_AT_RAPID) if symbols == PARAMETERS else symbols
    values, stds = (_collect_columns(windows, key, symbols) for key in ("value", "std"))
    values[stds == 0.0] = np.nan  # given, not estimated: a data sheet's value has no trend
    direction = np.array([window.direction for window in windows], dtype=np.float64)
    for k in (k for k, symbol in enumerate(symbols) if symbol in BY_DIRECTION):
        values[:, k] = remove_direction_bias(values[:, k], direction)
    time_s = np.array([window.stamp.wall_s for window in windows])
    celsius = np.array([np.nan if w.temperature_c is None else w.temperature_c for w in windows], dtype=np.float64)
    known = bool(np.isfinite(celsius).all())
    found = find_steps(values, stds, celsius if known else None, symbols)
    axis: dict[str, Any] = {"slopes": {}, "trends": {}, "limits": {}, "changes": _group_steps(found, windows)}
    for k, symbol in enumerate(symbols):
        since = max((step.row for step in found if step.name == symbol), default=0)
        y, std, kelvin = values[since:, k], stds[since:, k], celsius[since:]
        span_s = float(np.ptp(time_s[since:]))
        if line := fit_slope(y, kelvin, std, time_s[since:] if span_s >= WEAR_SPAN_S else None):
            centre = {"level": line.level, "at_celsius": line.at}
            axis["slopes"][symbol] = {
                "per_kelvin": line.value,
                "std": line.std,
                **_describe_interval(line.compute_interval()),
            } | centre
        if span_s < LEAST_SPAN_S:
            continue
        held = known and bool(np.ptp(kelvin) > 0)
        line = fit_slope(y, time_s[since:] / DAY_S, std, kelvin if held else None)
        if line is not None:
            rest: dict[str, Any] = {
                "level": line.level,
                "at": _format_date(line.at * DAY_S),
                "since": _format_date(time_s[since]),
            }
            rest["at_constant_temperature"] = held
            axis["trends"][symbol] = {
                "per_day": line.value,
                "std": line.std,
                **_describe_interval(line.compute_interval()),
            } | rest
            if symbol in limits:
                axis["limits"] |= _predict_limit_date(symbol, line, limits[symbol], float(time_s[-1]), span_s / DAY_S)
    return axis | {"windows": _describe_windows(windows, values, stds, symbols)}


def _collect_columns(windows: Sequence[StoredWindow], key: str, symbols: Sequence[str]) -> Float:
    import numpy as np

    from fdhil.identification import FRICTION_AT_RAPID

    known: list[dict[str, Any]] = [
        {**(window.parameters or {}), FRICTION_AT_RAPID: window.friction or {}} for window in windows
    ]
    columns = [[parameters.get(name, {}).get(key) for name in symbols] for parameters in known]
    return np.array(columns, dtype=np.float64).reshape(-1, len(symbols))


def _describe_interval(interval: tuple[float, float]) -> dict[str, float]:
    return {"low": interval[0], "high": interval[1]}


def _format_date(seconds: float) -> str:
    return datetime.fromtimestamp(float(seconds), UTC).isoformat(timespec="seconds")


def _predict_limit_date(
    symbol: str, line: Any, limit: tuple[float, float], newest_s: float, span_days: float
) -> dict[str, dict[str, Any]]:
    from fdhil.identification import find_crossing, limit_forecast_days

    first, share = limit
    value = first + abs(first) * (share if line.value > 0 else -share)
    reached = find_crossing(line, value)
    if reached is None or reached.at - newest_s / DAY_S > min(limit_forecast_days(span_days), FARTHEST_DAYS):
        return {}
    return {
        symbol: {"limit": value, "reached": reached.at * DAY_S <= newest_s, **_describe_crossing(reached, newest_s)}
    }


def _describe_crossing(reached: Crossing, newest_s: float) -> dict[str, str | None]:
    late = reached.high - newest_s / DAY_S > FARTHEST_DAYS
    return {
        "date": _format_date(reached.at * DAY_S),
        "earliest": _format_date(reached.low * DAY_S),
        "latest": None if late else _format_date(reached.high * DAY_S),
    }


def _group_steps(found: Sequence[Step], windows: Sequence[StoredWindow]) -> list[dict[str, Any]]:
    from fdhil.identification import FRICTION_AT_RAPID

    changes: list[list[Step]] = []
    for step in found:
        if changes and step.row - changes[-1][0].row <= TOGETHER:
            changes[-1].append(step)
        else:
            changes.append([step])
    described = []
    for together in changes:
        window = windows[together[0].row]
        parameters = {
            s.name: {"before": s.before, "after": s.before + s.size, "std": s.std, "unit": get_unit(s.name)}
            for s in together
        }
        # the sum of ft and Cd adds no cause to either of them
        moved_by = frozenset(name.removesuffix("/K") for name in parameters) - {FRICTION_AT_RAPID} or frozenset(
            {"ft", "Cd"}
        )
        cause = CAUSES.get(moved_by, "a changed drive or sensor")
        described.append(
            {
                "window": window.number,
                "time": _format_date(window.stamp.wall_s),
                "cause": cause,
                "parameters": parameters,
            }
        )
    return described


def _describe_windows(
    windows: Sequence[StoredWindow], values: Float, stds: Float, symbols: Sequence[str]
) -> list[dict[str, Any]]:
    import numpy as np

    def convert_finite(number: float) -> float | None:
        return float(number) if np.isfinite(number) else None

    return [
        {
            "window": window.number,
            "time": _format_date(window.stamp.wall_s),
            "temperature_c": window.temperature_c,
            "nc": window.nc,
            "parameters": {
                name: {"value": convert_finite(v), "std": convert_finite(s)}
                for name, v, s in zip(symbols, row, spread, strict=True)
            },
        }
        for window, row, spread in zip(windows, values, stds, strict=True)
    ]


def build_slope_rows(health: Mapping[str, Any]) -> list[list[str]]:
    """Return a row per parameter that has a slope: per kelvin, per day, and its limit's date."""
    slopes, trends, limits = (health[key] for key in ("slopes", "trends", "limits"))
    rows = []
    for name in DISPLAY_UNITS:
        if name in slopes or name in trends:
            cells = [
                format_cell(name, line[key], compute_half_width(line), " ") if (line := lines.get(name)) else "-"
                for lines, key in ((slopes, "per_kelvin"), (trends, "per_day"))
            ]
            rows.append(
                [f"{name.partition('_')[0]} {DISPLAY_UNITS[name][0]}", *cells, _describe_limit(name, limits.get(name))]
            )
    return rows


def describe_change(change: Mapping[str, Any]) -> str:
    """Describe a change in words."""
    parts = ((name, DISPLAY_UNITS[name], p) for name, p in change["parameters"].items())
    return ", ".join(
        f"{name} {p['before'] * factor:.4g} -> {p['after'] * factor:.4g} {unit}" for name, (unit, factor), p in parts
    )


def _describe_limit(name: str, limit: Mapping[str, Any] | None) -> str:
    if limit is None:
        return "-"
    value = f"{limit['limit'] * DISPLAY_UNITS[name][1]:.4g}"
    if limit["reached"]:
        return f"{value} reached"
    latest = limit["latest"][:10] if limit["latest"] else "open"
    return f"{value} on {limit['date'][:10]}\n({limit['earliest'][:10]} to {latest})"
