"""Names the states, files and times that the guard and its clients share, each once."""

from __future__ import annotations

from enum import StrEnum

SOCKET_NAME = "guard.sock"
SETTINGS_NAME = "guard.json"
TABLE_NAME = "fdhil-table"
HOLD_CYCLES = 10
"""SYNC for which a gap is held before it ends what was armed."""
RESERVE_S = 1.0
"""With so much left of a streamed table the guard ramps to zero."""


class Mode(StrEnum):
    """The guard's state; :mod:`fdhil.guard.transitions` says what leads from one to another."""

    OFF = "OFF"
    ADOPT = "ADOPT"
    ARMED = "ARMED"
    RAMPING = "RAMPING"
    ACTIVE = "ACTIVE"
    HOLD = "HOLD"
    RAMP_DOWN = "RAMP_DOWN"
    FROZEN = "FROZEN"


class FeedMode(StrEnum):
    """Whether the on-line feed-forward acts: ENDING fades out, ZEROING sends zeros at once."""

    OFF = "OFF"
    ON = "ON"
    ENDING = "ENDING"
    ZEROING = "ZEROING"


FEEDFORWARD = "FEEDFORWARD"
"""What a client is told as the state while the feed-forward is not OFF."""
ON_PATH = frozenset({Mode.RAMPING, Mode.ACTIVE, Mode.HOLD})
IN_CHARGE = ON_PATH | {Mode.ARMED}
LANDING = frozenset({Mode.ADOPT, Mode.RAMP_DOWN})
SENDING = IN_CHARGE | LANDING
AT_REST = frozenset({Mode.OFF, Mode.FROZEN})
CHARGED: frozenset[str] = IN_CHARGE | {FEEDFORWARD}
