"""Tables of the guard's states: what is sent in each, and which event leads where. The core has no other transition.

``docs/reference/guard.md`` is generated from here.
"""

from collections.abc import Collection, Mapping
from enum import Enum

from fdhil.guard.guard_protocol import AT_REST, IN_CHARGE, ON_PATH, RAMPING_MODES, SENDING, FeedMode, Mode

ZEROS = 3
ZEROS_UNCONFIRMED = 50
"""Cycles of zeros that end a ramp: when the drives show them, and when one does not."""


class Event(Enum):
    """What leads to another state; the value describes it."""

    ARM = "the operator arms, and nothing forbids it"
    ADOPT = "a drive holds a trusted offset, at the start or when the operator adopts"
    NOTHING_HELD = "the operator adopts, and all drives certainly hold 0"
    DOUBTFUL = "at the start a drive holds an offset that cannot be trusted"
    START = "the targets leave the path's start"
    ON_TABLE = "the offset is the table's"
    LATE = "a frame did not leave in time"
    GAP = "an interlock that holds fails"
    FOUND = "the interlock is good again, and the position on the path is known"
    END = "disarmed, stopped, the path ends, the daemon is lost, a hold is too long, an interlock that ramps down fails"
    HIJACK = "another node changed the offset"
    BLOCKED = "an interlock that freezes fails, or frames do not leave, or a drive's offset cannot be trusted"
    BLOCKED_AT_ZERO = "the same, but only zeros were sent and read back"
    ZERO_SHOWN = f"more than {ZEROS} cycles of zeros were sent, and the drives show them"
    ZERO_NOT_SHOWN = f"more than {ZEROS_UNCONFIRMED} cycles of zeros were sent, and a drive does not show them"


SENT: Mapping[Mode, str] = {
    Mode.OFF: "nothing",
    Mode.ADOPT: "the value that the drive holds, then toward 0",
    Mode.ARMED: "0, and the heartbeat",
    Mode.RAMPING: "toward the table's value, within the limits",
    Mode.ACTIVE: "the table's value",
    Mode.HOLD: "the last value, braked to rest",
    Mode.RAMP_DOWN: "toward 0",
    Mode.FROZEN: "nothing: the drive may still hold an offset",
}
FEED_SENT: Mapping[FeedMode, str] = {
    FeedMode.OFF: "nothing",
    FeedMode.ON: "what the law makes of the targets, faded in, within the limits",
    FeedMode.ENDING: "the same, faded out",
    FeedMode.ZEROING: "0 at once",
}
# (what happens, in which states, the next state)
TRANSITIONS: tuple[tuple[Event, Collection[Mode], Mode], ...] = (
    (Event.ARM, {Mode.OFF}, Mode.ARMED),
    (Event.ADOPT, AT_REST, Mode.ADOPT),
    (Event.NOTHING_HELD, AT_REST, Mode.OFF),
    (Event.DOUBTFUL, {Mode.OFF}, Mode.FROZEN),
    (Event.START, {Mode.ARMED}, Mode.RAMPING),
    (Event.ON_TABLE, {Mode.RAMPING}, Mode.ACTIVE),
    (Event.LATE, {Mode.ACTIVE}, Mode.RAMPING),
    (Event.GAP, {Mode.ARMED}, Mode.ARMED),
    (Event.GAP, ON_PATH, Mode.HOLD),
    (Event.FOUND, {Mode.HOLD}, Mode.RAMPING),
    (Event.END, IN_CHARGE, Mode.RAMP_DOWN),
    (Event.HIJACK, SENDING, Mode.RAMP_DOWN),
    (Event.BLOCKED, SENDING, Mode.FROZEN),
    (Event.BLOCKED_AT_ZERO, SENDING, Mode.OFF),
    (Event.ZERO_SHOWN, RAMPING_MODES, Mode.OFF),
    (Event.ZERO_NOT_SHOWN, RAMPING_MODES, Mode.FROZEN),
)
FEED_TRANSITIONS: tuple[tuple[Event, Collection[FeedMode], FeedMode], ...] = (
    (Event.ARM, {FeedMode.OFF}, FeedMode.ON),
    (Event.ADOPT, {FeedMode.OFF}, FeedMode.ZEROING),
    (Event.END, {FeedMode.ON}, FeedMode.ENDING),
    (Event.BLOCKED, {FeedMode.ON, FeedMode.ENDING}, FeedMode.ZEROING),
    (Event.ZERO_SHOWN, {FeedMode.ENDING, FeedMode.ZEROING}, FeedMode.OFF),
    (Event.ZERO_NOT_SHOWN, {FeedMode.ENDING, FeedMode.ZEROING}, FeedMode.OFF),
)
NEXT = {(mode, event): after for event, modes, after in TRANSITIONS for mode in modes}
NEXT_FEED = {(mode, event): after for event, modes, after in FEED_TRANSITIONS for mode in modes}
