"""Alarms and notices for the browser: active alarms first, each with cause, effect and next action."""

from collections.abc import Sequence
from typing import Any, Literal

from pydantic import BaseModel

from fdhil.daemon import MOST_TOGETHER, Alarm, AlarmTable, get_effect_and_action
from fdhil.store import StoredNotice, TimeStamp, format_date, make_notice_document

MOST_PAGE = 200
MOST_EARLIER = 50
Severity = Literal["info", "minor", "MAJOR"]


class Acknowledged(BaseModel):
    """Who acknowledged a notice, when, and with which note."""

    who: str
    time: str
    note: str


class Event(BaseModel):
    """A notice: its text, and separately its cause, its effect on the machine, and the next action."""

    number: int
    time: str
    axis: str
    code: str
    severity: Severity
    text: str
    cause: str
    effect: str
    action: str
    acknowledged: Acknowledged | None
    until: str | None = None


class Earlier(BaseModel):
    """An older notice of the same kind."""

    number: int
    time: str
    text: str


class Waiting(BaseModel):
    """An alarm that is active or unacknowledged: its newest notice, the unacknowledged ``numbers``, earlier ones.

    ``until`` is when its cause ended, null while it is active; it was raised ``count`` times since ``first_time``.
    """

    newest: Event
    state: Literal["active", "gone"]
    until: str | None
    count: int
    numbers: list[int]
    first_time: str
    earlier: list[Earlier]


class Events(BaseModel):
    """Active and unacknowledged alarms, the most urgent first; a page of the other notices, newest first.

    The end of an alarm is listed as a notice only with severity info. ``older_before`` requests the next page, null at
    the oldest.
    """

    waiting: list[Waiting]
    active_count: int
    waiting_count: int
    waiting_major: int
    newest_waiting: int | None
    others: list[Event]
    older_before: int | None
    codes: list[str]


def make_event(stored: StoredNotice, until: TimeStamp | None = None) -> Event:
    """Return a notice with its explanation, and when its cause ended."""
    effect, action = get_effect_and_action(stored.notice)
    text = stored.notice.text
    cause = text.partition(f"; {effect}")[0] if effect else text  # the guard's own text contains all three
    ended = None if until is None else format_date(until)
    return Event(**make_notice_document(stored), cause=cause, effect=effect, action=action, until=ended)


def make_event_page(notices: Sequence[StoredNotice], *, limit: int, before: int | None = None, **only: Any) -> Events:
    """Return the notices that match ``only`` (axis, code, severity; None: any); ``notices`` are oldest first.

    Without a severity those of severity info are left out.
    """
    table = AlarmTable(notices)
    shown = [alarm for alarm in table.list_shown() if _is_selected(alarm.newest, **only)]
    active = {alarm.newest.number for alarm in shown if alarm.until is None}
    waiting = [stored for stored in notices if stored.is_open and _is_selected(stored, **only)]
    others = [
        stored
        for stored in notices
        if not stored.is_open and stored.number not in active and _is_selected(stored, **only)
    ]
    older = [stored for stored in others if before is None or stored.number < before]
    newest = older[-limit:][::-1]
    return Events(
        waiting=[_make_waiting_alarm(alarm) for alarm in shown],
        active_count=len(active),
        waiting_count=len(waiting),
        waiting_major=sum(stored.notice.severity == "MAJOR" for stored in waiting),
        newest_waiting=waiting[-1].number if waiting else None,
        others=[make_event(stored, table.ended.get(stored.number)) for stored in newest],
        older_before=newest[-1].number if len(older) > limit else None,
        codes=sorted({stored.notice.code for stored in notices}),
    )


def _make_waiting_alarm(alarm: Alarm) -> Waiting:
    documents = [make_notice_document(stored) for stored in list(alarm.raised)[::-1]]
    earlier = [
        {key: document[key] for key in ("number", "time", "text")} for document in documents[1 : MOST_EARLIER + 1]
    ]
    return Waiting(
        newest=make_event(alarm.newest),
        state=alarm.state,
        until=None if alarm.until is None else format_date(alarm.until),
        count=alarm.count,
        numbers=sorted(alarm.waiting, reverse=True)[:MOST_TOGETHER],
        first_time=format_date(alarm.first),
        earlier=[Earlier(**document) for document in earlier],
    )


def _is_selected(stored: StoredNotice, axis: str | None, code: str | None, severity: Severity | None) -> bool:
    notice = stored.notice
    wanted = notice.severity == severity if severity else notice.severity != "info"
    return wanted and axis in (None, notice.axis) and code in (None, notice.code)
