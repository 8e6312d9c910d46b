"""Splits the bytes of a serial port into lines, each with the arrival time of its end."""

from collections import deque
from dataclasses import dataclass

from fdhil.drivers.serial.byte_stream import Chunk
from fdhil.drivers.serial.serial_port import SerialPort

LONGEST = 512  # characters; a longer line is not from an instrument


@dataclass(frozen=True, slots=True)
class TextLine:
    """A line without its end; its last character had arrived by ``t_ns`` (host-monotonic)."""

    text: str
    t_ns: int


class LineReader:
    """Splits received bytes into lines; carriage return, line feed and both end one. ``name`` is for messages."""

    def __init__(self, port: SerialPort, name: str) -> None:
        self._port = port
        self._name = name
        self._lines: deque[TextLine] = deque()
        self._begun = b""
        self.overlong = 0

    async def read_line(self, until_ns: int) -> TextLine | None:
        """Return the next line that is not empty, None when none has come by ``until_ns``; ConnectError."""
        while not self._lines:
            chunk = await self._port.receive_chunk(self._name, until_ns)
            if chunk is None:
                return None
            self._split_chunk(chunk)
        return self._lines.popleft()

    def _split_chunk(self, chunk: Chunk) -> None:
        *whole, self._begun = (self._begun + chunk.data.replace(b"\r", b"\n")).split(b"\n")
        left = len(self._begun) + sum(len(line) + 1 for line in whole)
        for line in whole:
            left -= len(line) + 1
            text = line.decode("ascii", "replace").strip()
            if len(line) > LONGEST:
                self.overlong += 1
            elif text:  # later bytes of the same read were on the wire after it
                self._lines.append(TextLine(text, chunk.t_ns - self._port.compute_wire_ns(left)))
        if len(self._begun) > LONGEST:
            self._begun, self.overlong = b"", self.overlong + 1

    def discard_lines(self) -> None:
        self._port.discard_input()
        self._lines.clear()
        self._begun = b""
