"""Keeps the NC's view of one drive and makes what is sent to it: set-points, steps to Operation enabled, SDO writes."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from fdhil.sim.drive.power import State
from fdhil.sim.frame import BusFrame

ENABLED = 0x0F
SHUTDOWN = 0x06
_WORDS = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY: 0x07,
    State.SWITCHED_ON: ENABLED,
    State.OPERATION_ENABLED: ENABLED,
    State.QUICK_STOP_ACTIVE: 0x00,
}


def power_state(statusword: int) -> State:
    """Return the power state that a statusword shows (CiA 402-2, table 30)."""
    for mask in (0x6F, 0x4F):
        try:
            return State(statusword & mask)
        except ValueError:
            continue
    return State.NOT_READY


@dataclass(slots=True)
class DriveLink:
    """One drive as the NC sees it: its default TPDO1 and TPDO2, and the controlword it was given last.

    ``increments_per_mm`` has the sign of the axis; ``silent`` counts the SYNCs since the last statusword.
    """

    axis: str
    bus: str
    node_id: int
    increments_per_mm: float
    delay: int
    word: int = SHUTDOWN
    status: int | None = None
    position: int | None = None
    silent: int = 0

    @property
    def state(self) -> State:
        """The power state that its last statusword shows."""
        return State.NOT_READY if self.status is None else power_state(self.status)

    def set_point(self, target: int) -> BusFrame:
        """RPDO1: controlword and target position."""
        return self.bus, (0x200 + self.node_id, struct.pack("<Hi", self.word, target))

    def walk(self) -> BusFrame | None:
        """One step toward Operation enabled, with the actual position as target."""
        if self.position is None:
            return None
        if self.state is State.FAULT:  # a reset is a rising edge
            self.word = 0x00 if self.word == 0x80 else 0x80
        else:
            self.word = _WORDS.get(self.state, self.word)
        return self.set_point(self.position)


@dataclass(slots=True)
class SdoWrite:
    """An SDO write of one byte that awaits its answer; ``required`` tells whether an abort matters."""

    link: DriveLink
    index: int
    value: int
    required: bool
    sent: bool = False
    cycles: int = 0

    @property
    def frame(self) -> BusFrame:
        """The expedited download (CiA 301, 7.2.4.3.3)."""
        write = struct.pack("<BHBI", 0x2F, self.index, 0, self.value)
        return self.link.bus, (0x600 + self.link.node_id, write)
