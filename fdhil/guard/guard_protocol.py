"""Names the states, files and times that the guard shares with its clients."""

from enum import StrEnum

SOCKET_NAME = "guard.sock"
SETTINGS_NAME = "guard.json"
TABLE_NAME = "fdhil-table"
HOLD_CYCLES = 10
"""SYNC cycles for which a gap is bridged before the correction ends."""
RESERVE_S = 1.0
"""Remaining time of a streamed table at which the guard ramps to zero."""


class Mode(StrEnum):
    """The guard's state; :mod:`fdhil.guard.state_transitions` lists the transitions."""

    OFF = "OFF"
    ADOPT = "ADOPT"
    ARMED = "ARMED"
    RAMPING = "RAMPING"
    ACTIVE = "ACTIVE"
    HOLD = "HOLD"
    RAMP_DOWN = "RAMP_DOWN"
    FROZEN = "FROZEN"


class FeedMode(StrEnum):
    """State of the on-line feed-forward: ENDING fades out, ZEROING sends zeros at once."""

    OFF = "OFF"
    ON = "ON"
    ENDING = "ENDING"
    ZEROING = "ZEROING"


FEEDFORWARD_STATE = "FEEDFORWARD"
"""The state that clients receive while the feed-forward is not OFF."""
ON_PATH = frozenset({Mode.RAMPING, Mode.ACTIVE, Mode.HOLD})
IN_CHARGE = ON_PATH | {Mode.ARMED}
RAMPING_MODES = frozenset({Mode.ADOPT, Mode.RAMP_DOWN})
SENDING = IN_CHARGE | RAMPING_MODES
AT_REST = frozenset({Mode.OFF, Mode.FROZEN})
CHARGED_STATES: frozenset[str] = IN_CHARGE | {FEEDFORWARD_STATE}
