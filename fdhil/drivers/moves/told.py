"""Tells G0 by what the NC itself says of its moves. Pure."""

from __future__ import annotations

from fdhil.config import MachineConfig
from fdhil.drivers.cia402.drive import InputSamples
from fdhil.records import AxisSamples, MoveEvent, MoveKind, NcState


class ToldG0:
    """Says what the NC says, at the newest tick."""

    needs_input = False
    least_share = 0.0

    def __init__(self, axis: str, config: MachineConfig) -> None:
        self._axis = axis
        self._source = config.g0.source
        self._tick = 0
        self._kind = MoveKind.UNKNOWN

    def feed(self, record: AxisSamples | InputSamples | NcState) -> list[MoveEvent]:
        """Take a block of samples, or what the NC says."""
        if isinstance(record, AxisSamples) and record.axis == self._axis and record.tick.size:
            self._tick = int(record.tick[-1])
        if not isinstance(record, NcState) or record.motion is self._kind:
            return []
        self._kind = record.motion
        return [MoveEvent(self._axis, record.motion, self._tick, self._source)]
