"""Records the last cycles of the drive, to be read by SDO block upload (vendor object 0x2120)."""

import struct

TRACE_CYCLES = 1024
# SYNC count, position demand, position actual (increments), speed (increments/s), current (0.1 %), voltage (0.02 V)
ROW = struct.Struct("<Iiiihh")


class TraceBuffer:
    """A ring buffer of the last ``TRACE_CYCLES`` rows."""

    def __init__(self) -> None:
        self._ring = bytearray(TRACE_CYCLES * ROW.size)
        self._rows = 0

    def clear_rows(self) -> None:
        self._rows = 0

    def append_row(self, tick: int, demand: int, position: int, speed: int, current: int, voltage: int) -> None:
        offset = self._rows % TRACE_CYCLES * ROW.size
        ROW.pack_into(self._ring, offset, tick & 0xFFFFFFFF, demand, position, speed, current, voltage)
        self._rows += 1

    def read_rows(self) -> bytes:
        """Return the rows, the oldest first."""
        if self._rows <= TRACE_CYCLES:
            return bytes(self._ring[: self._rows * ROW.size])
        start = self._rows % TRACE_CYCLES * ROW.size
        return bytes(self._ring[start:] + self._ring[:start])
