"""Says how a machine's drives are, from their history: each sentence by a rule, the most urgent first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from fdhil.records import PARAMETERS
from fdhil.report.history_course import AxisHistory
from fdhil.report.history_trends import moved
from fdhil.report.parameter_view import DISPLAY, cell, half_of

if TYPE_CHECKING:
    from fdhil.store.rows import StoredWindow

RECENT_DAYS = 7.0  # before the newest rapid: a change within is told first
NEWEST_RAPIDS = 100
MANY_REFUSED = 0.2  # of the newest rapids
IN_ORDER = "In order: no limit is near, and nothing stepped in the last week."
UNKNOWN = "Nothing was identified yet."


@dataclass(frozen=True, slots=True)
class Refusals:
    """The rapids of an axis that were not believed: how many of how many, and by reason the count and the last one."""

    seen: int = 0
    refused: int = 0
    newest_seen: int = 0
    newest_refused: int = 0
    reasons: tuple[tuple[str, int, str, str], ...] = ()  # code, how many, text of the last, time of the last


def refusals_of(windows: Sequence[StoredWindow]) -> Refusals:
    """Count what was refused of one axis' windows, oldest first."""
    refused = [window for window in windows if not window.accepted]
    newest = windows[-NEWEST_RAPIDS:]
    last: dict[str, tuple[str, str]] = {}
    counts: Counter[str] = Counter()
    for window in refused:
        time = datetime.fromtimestamp(window.stamp.wall_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
        for code, text in {_split(reason) for reason in window.reasons}:
            counts[code] += 1
            last[code] = (text, time)
    reasons = tuple((code, count, *last[code]) for code, count in counts.most_common())
    return Refusals(len(windows), len(refused), len(newest), sum(not w.accepted for w in newest), reasons)


def _split(reason: str) -> tuple[str, str]:
    code, _, text = reason.partition(":")
    return code, text.strip()


def sentences(history: AxisHistory, refused: Refusals) -> list[str]:
    """Return what is to be said of an axis, the most urgent first; that it is in order where nothing is."""
    told = history.told or {}
    said: list[str] = []
    for name, limit in told.get("limits", {}).items():
        value = f"{limit['limit'] * DISPLAY[name][1]:.4g} {DISPLAY[name][0]}"
        if limit["reached"]:
            said.insert(0, f"{name} has reached its maintenance limit of {value}: look at the axis now.")
        else:
            latest = limit["latest"][:10] if limit["latest"] else "later"
            span = f"between {limit['earliest'][:10]} and {latest}"
            said.append(f"{name} will reach its limit of {value} about {limit['date'][:10]} ({span}) if it goes on so.")
    said += [f"{moved(change)} on {change['time'][:10]}: {change['cause']}." for change in _recent(told)]
    if refused.seen and not told.get("windows"):
        said.append(f"None of {refused.seen} rapids was believed, {_most(refused)}.")
    elif refused.newest_refused > MANY_REFUSED * refused.newest_seen:
        newest = f"{refused.newest_refused} of the newest {refused.newest_seen} rapids were not believed"
        said.append(f"{newest}, {_most(refused)}.")
    if said:
        return said
    return [IN_ORDER if told.get("windows") else UNKNOWN]


def _recent(told: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    if not told.get("windows"):
        return []
    newest = datetime.fromisoformat(told["windows"][-1]["time"])
    ages = ((newest - datetime.fromisoformat(change["time"])).total_seconds() / 86_400 for change in told["changes"])
    return [change for change, age in zip(told["changes"], ages, strict=True) if age <= RECENT_DAYS]


def _most(refused: Refusals) -> str:
    code, count, text, _ = refused.reasons[0] if refused.reasons else ("no reason", refused.refused, "", "")
    return f"most often ({count} x) because of {code}" + (f": {text}" if text else "")


LATEST_HEAD = ("parameter", "latest", "unit", "nominal", "beside nominal", "since the first", "may change by", "limit")


def latest_rows(history: AxisHistory, shares: Mapping[str, float]) -> list[list[str]]:
    """Return a row per parameter: the newest published value beside the nominal one, the first one and its limit."""
    if not history.rows:
        return []
    first, newest = history.rows[0]["parameters"], history.rows[-1]["parameters"]
    limits = (history.told or {}).get("limits", {})
    rows = []
    for name in (name for name in PARAMETERS if name in newest):
        unit, factor = DISPLAY[name]
        value, nominal = newest[name]["value"], history.nominal.get(name)
        rows.append([
            name, cell(name, value, half_of(newest[name]), " "), unit,
            "-" if nominal is None else f"{nominal * factor:.4g}", _percent(value, nominal),
            _percent(value, first.get(name, {}).get("value")), f"±{100 * shares[name]:.0f} %", _limit(limits.get(name)),
        ])  # fmt: skip
    return rows


def _percent(value: float | None, beside: float | None) -> str:
    if value is None or not beside:
        return "-"
    return f"{round(100 * (value / beside - 1), 1) + 0.0:+.1f} %"  # + 0.0: never -0.0


def _limit(limit: Mapping[str, Any] | None) -> str:
    if limit is None:
        return "not in sight"
    return "reached" if limit["reached"] else f"about {limit['date'][:10]}"
