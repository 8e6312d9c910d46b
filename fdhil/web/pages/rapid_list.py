"""The stored rapids for the browser: their list, newest first, and the verdict on each. Reads only."""

from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from typing import Any, Literal

from pydantic import BaseModel

from fdhil.records import INTERVAL_95, get_unit
from fdhil.report import DISPLAY_UNITS, format_cell, typeset_text
from fdhil.store import History, StoredWindow
from fdhil.web.fault_responses import RequestRefused

SEARCHED = 5_000
"""Rows of the history searched by one request: with many more a rare reason would take seconds."""
LARGEST_ID = 2**63 - 1
Kept = Callable[[str], bool]
"""Returns whether the recording of this name still exists."""


class Said(BaseModel):
    """A reason or a warning: its code, the figure that caused it, the next action."""

    code: str
    text: str
    advice: str = ""


class NcSaid(BaseModel):
    """The NC's report during the move; missing items are null. An override of 1 is 100 %."""

    line: int | None = None
    program: str | None = None
    override: tuple[float, float] | None = None
    held: bool | None = None


class Rapid(BaseModel):
    """A stored rapid and the daemon's verdict; ``kept``: its recording still exists."""

    id: int
    axis: str
    time: str
    direction: int
    accepted: bool
    fit_percent: float | None
    unexplained_um: float | None
    temperature_celsius: float | None
    reasons: list[Said]
    warnings: list[Said]
    nc: NcSaid | None
    file: str
    kept: bool


class Rapids(BaseModel):
    """A page of rapids, newest first; ``older_before`` requests the next one, null at the oldest."""

    rapids: list[Rapid]
    older_before: int | None


class Count(BaseModel):
    """How many of the newest rapids were refused for a reason with this code."""

    code: str
    rapids: int


class Counts(BaseModel):
    """The newest rapids by verdict, and the refused ones by reason; ``searched`` is how many were examined.

    ``axes`` are the machine's.
    """

    axes: list[str]
    searched: int
    accepted: int
    refused: int
    by_reason: list[Count]


class Figure(BaseModel):
    """A parameter in SI units with its 95 % interval, and formatted; ``reason`` says why it is unknown."""

    name: str
    unit: str | None
    value: float | None
    std: float | None
    low: float | None
    high: float | None
    reason: str | None
    shown: str
    shown_unit: str


class RapidTold(BaseModel):
    """The stored data of one rapid, and its neighbours on the axis.

    ``alike_id`` is the last accepted one before it in the same direction.
    """

    rapid: Rapid
    parameters: list[Figure]
    older_id: int | None
    newer_id: int | None
    alike_id: int | None


Verdict = Literal["accepted", "refused"]


def read_rapid_page(
    history: History,
    is_stored: Kept,
    axis: str | None = None,
    verdict: Verdict | None = None,
    code: str | None = None,
    before: int | None = None,
    limit: int = 50,
) -> Rapids:
    """Return the newest matching rapids below the number ``before``."""
    before = find_newest_id(history) + 1 if before is None else before
    first = max(1, before - SEARCHED)
    wanted = {"axis = :axis": axis, "instr(reasons, :code)": None if code is None else f'"{code}:'}
    conditions = [condition for condition, value in wanted.items() if value is not None]
    if verdict is not None:
        conditions.append(f"accepted = {int(verdict == 'accepted')}")
    where = " AND ".join(["id < :before", "id >= :first", *conditions])
    values = {"before": before, "first": first, "axis": axis, "code": wanted["instr(reasons, :code)"]}
    found = history.select_windows(f"{where} ORDER BY id DESC", values, limit)
    oldest = found[-1].number if len(found) == limit else first
    return Rapids(
        rapids=[make_rapid(window, is_stored) for window in found], older_before=oldest if oldest > 1 else None
    )


def find_newest_id(history: History) -> int:
    """Return the number of the newest rapid, 0 without one."""
    return int(history.query_counts("SELECT coalesce(max(id), 0) FROM windows", {})[0][0])


def count_rapids(history: History, axes: Iterable[str], axis: str | None = None) -> Counts:
    """Count the newest rapids by verdict and by reason."""
    values = {"first": find_newest_id(history) - SEARCHED, "axis": axis}
    where = "windows.id > :first" + (" AND axis = :axis" if axis else "")
    verdicts = dict(
        history.query_counts(f"SELECT accepted, count(*) FROM windows WHERE {where} GROUP BY accepted", values)
    )
    by_reason = history.query_counts(
        "SELECT substr(value, 1, instr(value || ':', ':') - 1) AS code, count(DISTINCT windows.id) AS rapids"
        " FROM windows, json_each(CASE WHEN json_valid(reasons) THEN reasons ELSE '[]' END)"
        f" WHERE {where} AND accepted = 0 GROUP BY code ORDER BY rapids DESC, code",
        values,
    )
    accepted, refused = (int(verdicts.get(key, 0)) for key in (1, 0))
    reasons = [Count(code=str(code), rapids=int(number)) for code, number in by_reason]
    return Counts(axes=[*axes], searched=accepted + refused, accepted=accepted, refused=refused, by_reason=reasons)


def make_rapid(window: StoredWindow, is_stored: Kept) -> Rapid:
    """Return a stored window for the browser."""
    return Rapid(
        id=window.number,
        axis=window.axis,
        time=datetime.fromtimestamp(window.stamp.wall_s, UTC).isoformat(timespec="seconds"),
        direction=window.direction,
        accepted=window.accepted,
        fit_percent=window.fit_percent,
        unexplained_um=window.unexplained_um,
        temperature_celsius=window.temperature_c,
        reasons=[_split_reason(reason) for reason in window.reasons],
        warnings=[_split_reason(warning) for warning in window.warnings],
        nc=None if window.nc is None else NcSaid(**window.nc),
        file=window.file,
        kept=is_stored(window.file),
    )


def _split_reason(reason: str) -> Said:
    code, _, text = reason.partition(":")
    return Said(code=code, text=typeset_text(text.strip()))


def read_rapid_details(history: History, window: StoredWindow, is_stored: Kept) -> RapidTold:
    """Return the stored data of one rapid."""
    values = {"axis": window.axis, "id": window.number, "direction": window.direction}

    def find_nearest(condition: str, order: str) -> int | None:
        query = f"SELECT id FROM windows WHERE axis = :axis AND {condition} ORDER BY id {order} LIMIT 1"
        return next((int(row[0]) for row in history.query_counts(query, values)), None)

    return RapidTold(
        rapid=make_rapid(window, is_stored),
        parameters=[make_figure(name, values_of) for name, values_of in (window.parameters or {}).items()],
        older_id=find_nearest("id < :id", "DESC"),
        newer_id=find_nearest("id > :id", "ASC"),
        alike_id=find_nearest("id < :id AND direction = :direction AND accepted = 1", "DESC"),
    )


def make_figure(name: str, figures: dict[str, Any]) -> Figure:
    """Return one parameter of a window with its interval."""
    value, std = figures.get("value"), figures.get("std")
    half = None if std is None else INTERVAL_95 * std
    ends = (None, None) if value is None or half is None else (value - half, value + half)
    unit = get_unit(name)
    return Figure(
        name=name,
        unit=unit,
        value=value,
        std=std,
        low=ends[0],
        high=ends[1],
        reason=None if figures.get("reason") is None else typeset_text(str(figures["reason"])),
        shown=typeset_text(format_cell(name, value, half, " ")),
        shown_unit=typeset_text(DISPLAY_UNITS[name][0] if name in DISPLAY_UNITS else unit or ""),
    )


def read_window(history: History, axis: str, number: int) -> StoredWindow:
    """Return the window of an axis with this number; Refused if there is none, or it is damaged."""
    found = history.select_windows("id = :id AND axis = :axis", {"id": number, "axis": axis}, 1)
    if not found:
        text = f"the history has no rapid {number} of axis {axis}"
        raise RequestRefused(404, "NoSuchRapid", text, "use one from the list of rapids")
    return found[0]
