"""Detects rapid moves (G0); ``tables.EVENT_SOURCES`` lists the methods."""

from typing import ClassVar, Protocol

from fdhil import tables
from fdhil.config import MachineConfig
from fdhil.drivers.cia402.pdo_decoder import InputSamples
from fdhil.records import AxisSamples, MoveEvent, NcState, TickTimes


class EventSource(Protocol):
    """Detects the moves of one axis: blocks in, events out.

    ``needs_input``: whether the NC's signal must come with the drive's digital inputs. ``least_share``: of the rapid
    speed that a rapid must reach to be detected.
    """

    needs_input: ClassVar[bool]
    least_share: ClassVar[float]

    def __init__(self, axis: str, config: MachineConfig) -> None:
        pass

    def detect_moves(self, record: AxisSamples | InputSamples | TickTimes | NcState) -> list[MoveEvent]:
        """Take a block, or a state of the NC; return the detected moves."""


def load_event_source(name: str) -> type[EventSource]:
    source: type[EventSource] = tables.load_entry(tables.EVENT_SOURCES, name)
    return source
