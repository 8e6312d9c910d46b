"""Detects G0 by the NC's own signal: a bit of the drive's digital inputs (0x60FD). Pure.

The input comes in a slower TPDO than the samples, so an edge is known to that TPDO's period: the beginning is the tick
of the sample before the edge, the end the tick of the first sample after it.
"""

from fdhil.config import MachineConfig
from fdhil.drivers.cia402.pdo_decoder import InputSamples
from fdhil.records import AxisSamples, MoveEvent, MoveKind, NcState, TickTimes


class DigitalInputMoves:
    """Reports RAPID while the bit is set, REST when it falls."""

    needs_input = True
    least_share = 0.0

    def __init__(self, axis: str, config: MachineConfig) -> None:
        self._axis = axis
        self._mask = 1 << config.g0.input_bit
        self._high: bool | None = None
        self._last_tick = 0

    def detect_moves(self, record: AxisSamples | InputSamples | TickTimes | NcState) -> list[MoveEvent]:
        """Take a block of inputs; return the edges. The first sample only initialises the state."""
        if not isinstance(record, InputSamples) or record.axis != self._axis:
            return []
        events = []
        for tick, inputs in zip(record.tick.tolist(), record.inputs.tolist(), strict=True):
            high = bool(inputs & self._mask)
            if self._high is not None and high != self._high:
                kind = MoveKind.RAPID if high else MoveKind.REST
                events.append(MoveEvent(self._axis, kind, self._last_tick if high else tick, "digital_input"))
            self._high, self._last_tick = high, tick
        return events
