"""Derives alarms from a machine's notices: active, gone and acknowledged, the states of ISA-18.2. Pure.

A condition is a class of notice that lasts until a notice of severity info of the same class ends it. Every other class
is an event that is over when it is reported.
"""

import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from fdhil.records import Notice
from fdhil.store import Acknowledgement, StoredNotice, TimeStamp, format_date, make_acknowledgement_document

_LASTING = """
    BusDown BusErrors BusOff BusSilent DiskFull DriveEmergency ErrorPassive FeedHold GantrySkew GuardLost
    HeartbeatLost MaintenanceDue ModbusCrc ModbusException ModbusPortGone ModbusShape ModbusStale ModbusTimeout
    ModbusUnit MovesNotUsed NcSilent NoSamples NodeNeverHeard NotAcknowledged OverrideChanged PdoMissing
    PitchSuspect ReadOnlyStore ResourceHigh ScaleSuspect SerialPortGone SerialShape SerialTimeout SourceLost
    StoreFault SyncLost SyncPeriodSuspect TableSilent TransceiverFault
"""
CONDITIONS = frozenset(_LASTING.split())
ENDED_BY: Mapping[str, tuple[str, ...]] = {
    "StoreRecovered": ("DiskFull", "ReadOnlyStore", "StoreFault"),
    "GuardFound": ("GuardLost",),
}
KEPT_OVER_RESTART = frozenset({"MaintenanceDue"})
"""Conditions of the history, which a new daemon continues; it starts without the others."""
ENDS = 500
MOST_TOGETHER = 1000
_BUS, _PARAMETER = re.compile(r"[Bb]us ([\w.-]+)"), re.compile(r"(\w+)")
_SUBJECTS = {"BusDown": _BUS, "BusSilent": _BUS, "MaintenanceDue": _PARAMETER}
Key = tuple[str, str, str]


@dataclass(slots=True)
class Alarm:
    """The notices of one cause since it was last over and acknowledged; ``newest`` is the one that raised it last."""

    newest: StoredNotice
    first: TimeStamp
    until: TimeStamp | None = None
    count: int = 0
    raised: deque[StoredNotice] = field(default_factory=lambda: deque(maxlen=MOST_TOGETHER))
    waiting: set[int] = field(default_factory=set)
    given: Acknowledgement | None = None

    @property
    def state(self) -> Literal["active", "gone"]:
        """Whether the cause persists."""
        return "active" if self.until is None else "gone"

    @property
    def is_shown(self) -> bool:
        """Whether it needs attention: it is active, or waits to be acknowledged."""
        return self.until is None or bool(self.waiting)

    @property
    def urgency(self) -> tuple[bool, bool, int]:
        """Sort key: active before gone, MAJOR before minor, newest first."""
        return self.until is not None, self.newest.notice.severity != "MAJOR", -self.newest.number


class AlarmTable:
    """A machine's alarms, built from its notices in order."""

    def __init__(self, notices: Iterable[StoredNotice] = ()) -> None:
        self._alarms: dict[Key, Alarm] = {}
        self.ended: dict[int, TimeStamp] = {}
        """End of each ended alarm, by the number of the notice that raised it last and of the one that ended it."""
        for stored in notices:
            self.take_notice(stored)

    def take_notice(self, stored: StoredNotice) -> None:
        """Take the next notice."""
        notice = stored.notice
        codes = ENDED_BY.get(notice.code, (notice.code,) if notice.severity == "info" else ())
        own = get_alarm_key(notice)
        for key in [key for key in self._alarms if key[0] in codes and (key[0] != notice.code or key == own)]:
            self._end_alarm(key, stored)
        if notice.severity != "info":
            self._raise_alarm(own, stored)

    def _raise_alarm(self, key: Key, stored: StoredNotice) -> None:
        alarm = self._alarms.get(key)
        if alarm is None:
            alarm = self._alarms[key] = Alarm(stored, stored.stamp)
        alarm.newest = stored
        alarm.until = None if stored.notice.code in CONDITIONS else stored.stamp
        alarm.given = stored.acknowledged
        alarm.count += 1
        alarm.raised.append(stored)
        if stored.is_open:
            alarm.waiting.add(stored.number)
        self._drop_finished(key)

    def _end_alarm(self, key: Key, stored: StoredNotice) -> None:
        alarm = self._alarms[key]
        if alarm.until is None:
            alarm.until = stored.stamp
            self.ended[alarm.newest.number] = self.ended[stored.number] = stored.stamp
            for old in list(self.ended)[:-ENDS]:
                del self.ended[old]
        self._drop_finished(key)

    def forget_notice(self, number: int) -> None:
        """Drop a notice that is too old to be acknowledged."""
        for key, alarm in list(self._alarms.items()):
            if number in alarm.waiting:
                alarm.waiting.discard(number)
                self._drop_finished(key)

    def acknowledge_notices(self, given: Acknowledgement) -> None:
        """Record that notices were acknowledged."""
        for key, alarm in list(self._alarms.items()):
            if alarm.waiting.intersection(given.notices):
                alarm.waiting.difference_update(given.notices)
                alarm.given = given
                self._drop_finished(key)

    def _drop_finished(self, key: Key) -> None:
        if not self._alarms[key].is_shown:
            del self._alarms[key]

    def list_shown(self) -> list[Alarm]:
        """Return the alarms that are active or wait to be acknowledged, the most urgent first."""
        return sorted(self._alarms.values(), key=lambda alarm: alarm.urgency)

    def end_previous_conditions(self) -> list[Notice]:
        """Return notices that end the conditions of an earlier daemon; what persists is reported again."""
        left = [key for key, alarm in self._alarms.items() if alarm.until is None and key[0] not in KEPT_OVER_RESTART]
        text = "The daemon was restarted; the condition is reported again if it persists."
        return [Notice(code, "info", f"Bus {about}: {text}" if about else text, axis) for code, axis, about in left]


def get_alarm_key(notice: Notice) -> Key:
    """Return class, axis and, where an axis may have several alarms of the class, the bus or parameter it names."""
    pattern = _SUBJECTS.get(notice.code)
    named = pattern.search(notice.text) if pattern else None
    return notice.code, notice.axis, named[1] if named else ""


def build_alarm_document(alarm: Alarm) -> dict[str, Any]:
    """Return an alarm as a JSON document; ``since`` is the last time that it was raised."""
    notice = alarm.newest.notice
    return {
        "code": notice.code,
        "axis": notice.axis,
        "severity": notice.severity,
        "text": notice.text,
        "state": alarm.state,
        "since": format_date(alarm.newest.stamp),
        "until": None if alarm.until is None else format_date(alarm.until),
        "first": format_date(alarm.first),
        "count": alarm.count,
        "numbers": sorted(alarm.waiting, reverse=True),
        "acknowledged": None if alarm.waiting else make_acknowledgement_document(alarm.given),
    }


def build_alarms_status(alarms: Sequence[Alarm], most: int) -> dict[str, Any]:
    """Return how many alarms are active or unacknowledged, and the first ``most``, as a JSON document."""
    active = sum(alarm.until is None for alarm in alarms)
    waiting = sum(bool(alarm.waiting) for alarm in alarms)
    first = [build_alarm_document(alarm) for alarm in alarms[:most]]
    return {"active": active, "unacknowledged": waiting, "first": first}
