"""The notices as the browser has them: those that wait in front, each with its cause, effect and next action."""

from collections.abc import Sequence
from typing import Any, Literal

from pydantic import BaseModel

from fdhil.daemon.notice_words import words_of
from fdhil.store.notice_document import notice_document
from fdhil.store.rows import StoredNotice

MOST_PAGE = 200
MOST_TOGETHER = 1000
MOST_EARLIER = 50
Severity = Literal["info", "minor", "MAJOR"]


class Acknowledged(BaseModel):
    """Who answered for a notice, when, and what was remarked."""

    who: str
    time: str
    note: str


class Event(BaseModel):
    """A notice: what happened, its cause alone, what it means for the machine, what to do next."""

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


class Earlier(BaseModel):
    """An older notice of the same kind."""

    number: int
    time: str
    text: str


class Waiting(BaseModel):
    """The notices of one class and place that wait: the newest, the ``numbers`` of all, and what the others said."""

    newest: Event
    numbers: list[int]
    first_time: str
    earlier: list[Earlier]


class Events(BaseModel):
    """Notices: those that wait, by kind, MAJOR in front; a page of the others, newest first.

    ``older_before`` asks for the next page, null at the oldest.
    """

    waiting: list[Waiting]
    waiting_count: int
    waiting_major: int
    newest_waiting: int | None
    others: list[Event]
    older_before: int | None
    codes: list[str]


def event(stored: StoredNotice) -> Event:
    """Return a notice with the words that explain it."""
    effect, action = words_of(stored.notice)
    text = stored.notice.text
    cause = text.partition(f"; {effect}")[0] if effect else text  # the guard's own sentence tells all three
    return Event(**notice_document(stored), cause=cause, effect=effect, action=action)


def page(notices: Sequence[StoredNotice], *, limit: int, before: int | None = None, **only: Any) -> Events:
    """Return the notices that are as ``only`` says (axis, code, severity; None: any), oldest first as they are given.

    Without a severity those of severity info are left out.
    """
    chosen = [stored for stored in notices if _is(stored, **only)]
    waiting = [stored for stored in chosen if stored.is_open]
    others = [stored for stored in chosen if not stored.is_open and (before is None or stored.number < before)]
    shown = others[-limit:][::-1]
    return Events(
        waiting=_by_kind(waiting),
        waiting_count=len(waiting),
        waiting_major=sum(stored.notice.severity == "MAJOR" for stored in waiting),
        newest_waiting=waiting[-1].number if waiting else None,
        others=[event(stored) for stored in shown],
        older_before=shown[-1].number if len(others) > limit else None,
        codes=sorted({stored.notice.code for stored in notices}),
    )


def _by_kind(waiting: Sequence[StoredNotice]) -> list[Waiting]:
    kinds: dict[tuple[str, str], list[StoredNotice]] = {}
    for stored in waiting[::-1]:
        kinds.setdefault((stored.notice.code, stored.notice.axis), []).append(stored)
    told = [_together(kind[:MOST_TOGETHER]) for kind in kinds.values()]
    return sorted(told, key=lambda kind: (kind.newest.severity != "MAJOR", -kind.newest.number))


def _together(kind: Sequence[StoredNotice]) -> Waiting:
    documents = [notice_document(stored) for stored in kind]
    earlier = [{key: told[key] for key in ("number", "time", "text")} for told in documents[1 : MOST_EARLIER + 1]]
    return Waiting(
        newest=event(kind[0]),
        numbers=[stored.number for stored in kind],
        first_time=documents[-1]["time"],
        earlier=[Earlier(**told) for told in earlier],
    )


def _is(stored: StoredNotice, axis: str | None, code: str | None, severity: Severity | None) -> bool:
    notice = stored.notice
    wanted = notice.severity == severity if severity else notice.severity != "info"
    return wanted and axis in (None, notice.axis) and code in (None, notice.code)
