"""Translates the CAN controller's error frames (linux/can/error.h) into notices. Pure: no clock, no I/O."""

from typing import Literal

import numpy as np

from fdhil.drivers.can.frame_ring import ERROR_FLAG, Frames
from fdhil.records import Bool, Notice

# classes of an error frame's id
ERROR_CONTROLLER = 0x004
ERROR_PROTOCOL = 0x008
ERROR_TRANSCEIVER = 0x010
ERROR_NO_ACKNOWLEDGE = 0x020
ERROR_BUS_OFF = 0x040
ERROR_BUS = 0x080
ERROR_RESTARTED = 0x100
# data[1] of a controller error
CONTROLLER_OVERFLOW = 0x01
CONTROLLER_WARNING = 0x04 | 0x08
CONTROLLER_PASSIVE = 0x10 | 0x20
CONTROLLER_ACTIVE = 0x40
# data[2] of a protocol error
_DAMAGE = {0x01: "bit", 0x02: "form", 0x04: "stuff", 0x08: "dominant bit", 0x10: "recessive bit", 0x20: "overload"}
_QUIET_NS = 10_000_000_000  # without repetition until a condition has ended
_RECOVERED = {
    "BusOff": "The CAN controller is back on the bus.",
    "ErrorPassive": "The CAN controller is error-active again.",
    "BusErrors": "No frame was damaged for 10 s.",
    "NotAcknowledged": "Every frame was acknowledged for 10 s.",
    "TransceiverFault": "The CAN transceiver has reported no fault for 10 s.",
}

Severity = Literal["minor", "MAJOR"]
_WHOLE: tuple[tuple[int, str, Severity, str], ...] = (
    (
        ERROR_BUS_OFF,
        "BusOff",
        "MAJOR",
        "The CAN controller went bus-off: offsets in the drives cannot be changed; check the wiring and bit rate.",
    ),
    (
        ERROR_RESTARTED,
        "BusRestarted",
        "MAJOR",
        "The CAN controller was restarted; the offsets in the drives must be read back before anything is written.",
    ),
    (
        ERROR_TRANSCEIVER,
        "TransceiverFault",
        "MAJOR",
        "The CAN transceiver reports a line fault: frames may be lost; check the cable for breaks and shorts.",
    ),
    (
        ERROR_NO_ACKNOWLEDGE,
        "NotAcknowledged",
        "minor",
        "A frame that left this computer was acknowledged by no node; check the drives' supply, wiring and bit rate.",
    ),
)
_OF_CONTROLLER: tuple[tuple[int, str, Severity, str], ...] = (
    (
        CONTROLLER_PASSIVE,
        "ErrorPassive",
        "MAJOR",
        "The CAN controller is error-passive: frames may be lost; check termination, shield and bit rate.",
    ),
    (
        CONTROLLER_WARNING,
        "ErrorPassive",
        "minor",
        "The CAN controller counts errors (warning level); check termination and shield.",
    ),
    (
        CONTROLLER_OVERFLOW,
        "RxOverflow",
        "minor",
        "The CAN controller's buffer overflowed: an unknown number of frames was lost; reduce the computer's load.",
    ),
)


def translate_error_frames(frames: Frames) -> list[Notice]:
    """Translate error frames into notices, each code at most once per block.

    >>> from fdhil.drivers.can.frame_ring import pack_frames
    >>> [n.code for n in translate_error_frames(pack_frames([(0, ERROR_FLAG | ERROR_BUS_OFF, bytes(8))]))]
    ['BusOff']
    """
    errors = frames[frames["id"] & ERROR_FLAG != 0]
    if errors.size == 0:
        return []
    classes = int(np.bitwise_or.reduce(errors["id"] & 0x1FFFFFFF))
    found = [row[1:] for row in _WHOLE if classes & row[0]]
    found += [row[1:] for row in _OF_CONTROLLER if _combine_data_byte(errors, ERROR_CONTROLLER, 1) & row[0]]
    if classes & (ERROR_PROTOCOL | ERROR_BUS):
        found.append(("BusErrors", "minor", _describe_damage(_combine_data_byte(errors, ERROR_PROTOCOL, 2))))
    notices: dict[str, Notice] = {}
    for code, severity, text in found:  # the gravest of a code comes first
        notices.setdefault(code, Notice(code, severity, text))
    return list(notices.values())


def _combine_data_byte(errors: Frames, of_class: int, byte: int) -> int:
    data = errors["data"][errors["id"] & of_class != 0]
    return int(np.bitwise_or.reduce(data) >> 8 * byte & 0xFF) if data.size else 0


def _describe_damage(kinds: int) -> str:
    named = ", ".join(name for bit, name in _DAMAGE.items() if kinds & bit)
    how = f" ({named} errors)" if named else ""
    return f"Frames on the bus are damaged{how} and sent again; check termination, shield and bit rate."


class ErrorFrameMonitor:
    """Reports each error code when it first occurs, and when it has ended; repeated frames are only counted."""

    def __init__(self) -> None:
        self.count = 0
        self._reported: dict[str, Notice] = {}
        self._newest_ns: dict[str, int] = {}
        self._lasting: set[str] = set()

    def watch_frames(self, frames: Frames, now_ns: int) -> list[Notice]:
        """Take a block of frames; ``now_ns`` is the host's monotonic time."""
        found = translate_error_frames(frames)
        self.count += int(np.count_nonzero(frames["id"] & ERROR_FLAG))
        fresh = [notice for notice in found if self._is_new(notice)]
        for notice in found:
            self._newest_ns[notice.code] = int(frames["t_ns"][-1])
        if self._reported and frames.size:
            self._track_controller(frames)
        return [*fresh, *self._report_recovery(now_ns)]

    def _is_new(self, notice: Notice) -> bool:
        reported = self._reported.get(notice.code)
        if reported is not None and (reported.severity == "MAJOR" or notice.severity == "minor"):
            return False
        self._reported[notice.code] = notice
        return True

    def _track_controller(self, frames: Frames) -> None:
        """Track the controller: bus-off ends with a received frame, error-passive when it reports so."""
        error = frames["id"] & ERROR_FLAG != 0
        of_class = np.where(error, frames["id"], 0)
        detail = np.where(of_class & ERROR_CONTROLLER, frames["data"] >> np.uint64(8), 0)
        active = (detail & CONTROLLER_ACTIVE != 0) | (of_class & ERROR_RESTARTED != 0)
        passive = detail & (CONTROLLER_WARNING | CONTROLLER_PASSIVE) != 0
        self._track_condition("BusOff", of_class & ERROR_BUS_OFF != 0, active | ~error)
        self._track_condition("ErrorPassive", passive, active)

    def _track_condition(self, code: str, begins: Bool, ends: Bool) -> None:
        began, ended = (int(np.flatnonzero(which)[-1]) if which.any() else -1 for which in (begins, ends))
        if began > ended:
            self._lasting.add(code)
        elif ended >= 0:
            self._lasting.discard(code)

    def _report_recovery(self, now_ns: int) -> list[Notice]:
        over = [c for c, t_ns in self._newest_ns.items() if c not in self._lasting and now_ns - t_ns > _QUIET_NS]
        for code in over:
            del self._newest_ns[code], self._reported[code]
        return [Notice(code, "info", _RECOVERED[code]) for code in over if code in _RECOVERED]
