"""Summarises the condition of a machine's drives from their history, the most urgent sentence first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from fdhil.records import PARAMETERS
from fdhil.report.drive_health import describe_change
from fdhil.report.history_charts import AxisHistory
from fdhil.report.parameter_format import DISPLAY_UNITS, compute_half_width, format_cell

if TYPE_CHECKING:
    from fdhil.store import StoredWindow

RECENT_DAYS = 7.0  # before the newest rapid: changes within are reported
NEWEST_RAPIDS = 100
MANY_REFUSED = 0.2  # of the newest rapids
IN_ORDER = "In order: no limit is near, and no parameter stepped in the last week."
NOT_IDENTIFIED = "Nothing has been identified yet."


@dataclass(frozen=True, slots=True)
class Refusals:
    """The refused rapids of an axis: how many of how many, and for each reason the count and the last one."""

    seen: int = 0
    refused: int = 0
    newest_seen: int = 0
    newest_refused: int = 0
    reasons: tuple[tuple[str, int, str, str], ...] = ()  # code, how many, text of the last, time of the last


def count_refusals(windows: Sequence[StoredWindow]) -> Refusals:
    """Count the refusals among one axis' windows, oldest first."""
    refused = [window for window in windows if not window.accepted]
    newest = windows[-NEWEST_RAPIDS:]
    last: dict[str, tuple[str, str]] = {}
    counts: Counter[str] = Counter()
    for window in refused:
        time = datetime.fromtimestamp(window.stamp.wall_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
        for code, _, text in {reason.partition(":") for reason in window.reasons}:
            counts[code] += 1
            last[code] = (text.strip(), time)
    reasons = tuple((code, count, *last[code]) for code, count in counts.most_common())
    return Refusals(len(windows), len(refused), len(newest), sum(not w.accepted for w in newest), reasons)


def describe_condition(history: AxisHistory, refused: Refusals) -> list[str]:
    """Describe an axis' condition, the most urgent first; report that it is in order otherwise."""
    health = history.health or {}
    sentences: list[str] = []
    for name, limit in health.get("limits", {}).items():
        value = f"{limit['limit'] * DISPLAY_UNITS[name][1]:.4g} {DISPLAY_UNITS[name][0]}"
        if limit["reached"]:
            sentences.insert(0, f"{name} has reached its maintenance limit of {value}: inspect the axis now.")
        else:
            latest = limit["latest"][:10] if limit["latest"] else "later"
            span = f"between {limit['earliest'][:10]} and {latest}"
            sentences.append(
                f"{name} will reach its limit of {value} about {limit['date'][:10]} ({span}) if the trend continues."
            )
    sentences += [
        f"{describe_change(change)} on {change['time'][:10]}: {change['cause']}."
        for change in _select_recent_changes(health)
    ]
    if refused.seen and not health.get("windows"):
        sentences.append(f"None of {refused.seen} rapids was accepted, {_describe_main_reason(refused)}.")
    elif refused.newest_refused > MANY_REFUSED * refused.newest_seen:
        newest = f"{refused.newest_refused} of the newest {refused.newest_seen} rapids were not accepted"
        sentences.append(f"{newest}, {_describe_main_reason(refused)}.")
    return sentences or [IN_ORDER if health.get("windows") else NOT_IDENTIFIED]


def _select_recent_changes(health: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    if not health.get("windows"):
        return []
    newest = datetime.fromisoformat(health["windows"][-1]["time"])
    ages = ((newest - datetime.fromisoformat(change["time"])).total_seconds() / 86_400 for change in health["changes"])
    return [change for change, age in zip(health["changes"], ages, strict=True) if age <= RECENT_DAYS]


def _describe_main_reason(refused: Refusals) -> str:
    code, count, text, _ = refused.reasons[0] if refused.reasons else ("no reason", refused.refused, "", "")
    return f"most often ({count} x) because of {code}" + (f": {text}" if text else "")


LATEST_HEAD = ("parameter", "latest", "unit", "nominal", "against nominal", "since the first", "may change by", "limit")


def build_latest_rows(history: AxisHistory, shares: Mapping[str, float]) -> list[list[str]]:
    """Return a row per parameter: the newest published value, the nominal one, the change since the first, and the
    limit.
    """
    if not history.rows:
        return []
    first, newest = history.rows[0]["parameters"], history.rows[-1]["parameters"]
    limits = (history.health or {}).get("limits", {})
    rows = []
    for name in (name for name in PARAMETERS if name in newest):
        unit, factor = DISPLAY_UNITS[name]
        value, nominal = newest[name]["value"], history.nominal.get(name)
        rows.append([
            name, format_cell(name, value, compute_half_width(newest[name]), " "), unit,
            "-" if nominal is None else f"{nominal * factor:.4g}", _format_percent(value, nominal),
            _format_percent(value, first.get(name, {}).get("value")), f"±{100 * shares[name]:.0f} %",
            _describe_limit(limits.get(name)),
        ])  # fmt: skip
    return rows


def _format_percent(value: float | None, reference: float | None) -> str:
    if value is None or not reference:
        return "-"
    return f"{round(100 * (value / reference - 1), 1) + 0.0:+.1f} %"  # + 0.0: never -0.0


def _describe_limit(limit: Mapping[str, Any] | None) -> str:
    if limit is None:
        return "not foreseeable"
    return "reached" if limit["reached"] else f"about {limit['date'][:10]}"
