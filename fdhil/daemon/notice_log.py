"""Tracks which notices are unacknowledged, and who acknowledged the others."""

import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from fdhil.arming import make_refusal
from fdhil.daemon.alarms import AlarmTable, build_alarms_status
from fdhil.daemon.service_log import escape_unprintable
from fdhil.errors import FdhilError
from fdhil.records import Notice
from fdhil.store import (
    RECENT_NOTICES,
    Acknowledgement,
    StoredNotice,
    TimeStamp,
    make_acknowledgement_document,
    make_notice_document,
)

NEWEST = RECENT_NOTICES
TOLD_OPEN = 20  # open notices in the status
LAST_STORED = 100  # notices whose numbers the status can show
MOST_WHO, MOST_NOTE = 64, 200  # characters


class NotAcknowledged(FdhilError):
    """An acknowledgement that is refused; ``answer`` gives the reason."""

    def __init__(self, code: str, text: str, advice: str) -> None:
        super().__init__(text)
        self.answer = make_refusal(code, text, advice)


class NoticeLog:
    """The newest notices of the history: each while it is open, then only its acknowledgement. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._by_number: dict[int, StoredNotice | Acknowledgement] = {}
        self._last: deque[tuple[Notice, int]] = deque(maxlen=LAST_STORED)
        self._alarms = AlarmTable()

    def load_history(self, notices: Sequence[StoredNotice]) -> None:
        """Load the history, oldest first."""
        with self._lock:
            self._last.clear()
            self._alarms = AlarmTable(notices)
            asking = [notice for notice in notices if notice.notice.severity != "info"]
            self._by_number = {notice.number: notice.acknowledged or notice for notice in asking}

    def add_stored(self, notice: Notice, number: int, stamp: TimeStamp) -> None:
        """Add a stored notice."""
        with self._lock:
            self._last.append((notice, number))
            kept = StoredNotice(number, notice, stamp)
            self._alarms.take_notice(kept)
            if notice.severity != "info":
                self._by_number[number] = kept
                for old in list(self._by_number)[:-NEWEST]:
                    del self._by_number[old]
                    self._alarms.forget_notice(old)

    def select_open(self, request: Mapping[str, Any]) -> list[int]:
        """Return the open notices that a request names; NotAcknowledged where it names none or unknown ones."""
        numbers, up_to = request.get("notices"), request.get("up_to")
        with self._lock:
            waiting = [notice.number for notice in self._list_open()]
            if isinstance(up_to, int) and _is_number(up_to) and numbers is None:
                return [number for number in waiting if number <= up_to]
            if not (isinstance(numbers, list) and numbers and all(map(_is_number, numbers)) and up_to is None):
                text = "the request selects no notices"
                raise NotAcknowledged("BadRequest", text, "give 'notices' (a list of numbers) or 'up_to' (a number)")
            if unknown := [number for number in numbers if number not in self._by_number]:
                text = f"there is no notice {', '.join(map(str, unknown[:5]))} that can be acknowledged"
                raise NotAcknowledged("NoSuchNotice", text, "fdhil status shows the numbers of open notices")
        named = set(numbers)
        return [number for number in waiting if number in named]

    def note_acknowledged(self, given: Acknowledgement) -> None:
        """Record that notices were acknowledged."""
        with self._lock:
            self._alarms.acknowledge_notices(given)
            for number in given.notices:
                if number in self._by_number:
                    self._by_number[number] = given

    def describe_stored(self, notice: Notice) -> dict[str, Any]:
        """Return the number of a notice in the history (None: not stored yet) and its acknowledgement."""
        with self._lock:
            number = next((number for stored, number in reversed(self._last) if stored is notice), None)
            entry = self._by_number.get(number) if number is not None else None
        given = entry if isinstance(entry, Acknowledgement) else None
        return {"number": number, "acknowledged": make_acknowledgement_document(given)}

    def build_status(self) -> dict[str, Any]:
        """Return how many notices are unacknowledged, how many of them MAJOR, and the newest, oldest first."""
        with self._lock:
            waiting = self._list_open()
        major = sum(notice.notice.severity == "MAJOR" for notice in waiting)
        return {
            "count": len(waiting),
            "MAJOR": major,
            "newest": [make_notice_document(notice) for notice in waiting[-TOLD_OPEN:]],
        }

    def build_alarms_status(self) -> dict[str, Any]:
        """Return the alarms for the status, the most urgent first."""
        with self._lock:
            return build_alarms_status(self._alarms.list_shown(), TOLD_OPEN)

    def end_previous_conditions(self) -> list[Notice]:
        """Return notices that end the conditions of an earlier daemon."""
        with self._lock:
            return self._alarms.end_previous_conditions()

    def _list_open(self) -> list[StoredNotice]:
        return [each for each in self._by_number.values() if isinstance(each, StoredNotice)]


def _is_number(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def parse_acknowledgement(
    request: Mapping[str, Any], numbers: Sequence[int], stamp: TimeStamp | None = None
) -> Acknowledgement:
    """Parse an acknowledgement made now; NotAcknowledged where the request is invalid."""
    who, note = request.get("by"), request.get("note", "")
    if not isinstance(who, str) or not who.strip() or len(who) > MOST_WHO:
        text = "the acknowledgement has no name"
        raise NotAcknowledged("BadRequest", text, f"give a name of at most {MOST_WHO} characters as 'by'")
    if not isinstance(note, str) or len(note) > MOST_NOTE:
        text = "the note is not a text, or too long"
        raise NotAcknowledged("BadRequest", text, f"give a text of at most {MOST_NOTE} characters as 'note'")
    return Acknowledgement(
        tuple(numbers), escape_unprintable(who.strip()), escape_unprintable(note.strip()), stamp or TimeStamp.now()
    )


def describe_numbers(numbers: Sequence[int]) -> str:
    """Return a short text for these notices, such as ``3 notices (number 4 to 9)``."""
    if len(numbers) == 1:
        return f"notice {numbers[0]}"
    return f"{len(numbers)} notices" + (f" (number {min(numbers)} to {max(numbers)})" if numbers else "")
