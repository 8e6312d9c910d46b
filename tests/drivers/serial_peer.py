"""The far end of a serial line on a pseudo terminal: Modbus RTU units, or an instrument that sends lines of text."""

from __future__ import annotations

import asyncio
import contextlib
import os
import selectors
import struct
import time
import tty
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from functools import wraps
from typing import Any
from unittest.mock import patch

from pymodbus.framer import FramerRTU

from fdhil.drivers.modbus import rtu_line
from fdhil.drivers.serial import byte_stream, serial_port

LOOK_S = 0.01
Spoil = Callable[[bytes], list[bytes]]
"""What really comes on the line instead of an answer: pieces, one after the other."""


def build_frame(unit: int, body: bytes) -> bytes:
    """Return a frame with its checksum."""
    frame = bytes([unit]) + body
    return frame + struct.pack(">H", FramerRTU.compute_CRC(frame))


async def wait_until(condition: Callable[[], object]) -> None:
    """Wait until a condition holds; fail after a minute."""
    for _ in range(12_000):
        if condition():
            return
        await asyncio.sleep(0.005)
    raise TimeoutError


class PatientLoop(asyncio.SelectorEventLoop):
    """A loop whose time advances at most 20 ms per iteration, so that a delayed computer causes no time-out."""

    def __init__(self) -> None:
        super().__init__(_OftenLooking())
        self._now_s, self._seen_s = 0.0, time.monotonic()

    def time(self) -> float:
        """Return the loop's time, s."""
        seen_s = time.monotonic()
        self._now_s += min(seen_s - self._seen_s, 2 * LOOK_S)
        self._seen_s = seen_s
        return self._now_s

    def monotonic_ns(self) -> int:
        """Replace ``time.monotonic_ns``."""
        return round(self.time() * 1e9)


class _OftenLooking(selectors.DefaultSelector):
    def select(self, timeout: float | None = None) -> Any:
        return super().select(None if timeout is None else min(timeout, LOOK_S))


def run_patiently(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test and its serial line in the time of a patient loop; missing answers still time out soon."""

    @wraps(test)
    def run(*given: Any, **named: Any) -> None:
        loop = PatientLoop()
        with (
            patch.object(rtu_line, "time", loop),
            patch.object(serial_port, "time", loop),
            patch.object(byte_stream, "time", loop),
            asyncio.Runner(loop_factory=lambda: loop) as runner,
        ):
            runner.run(test(*given, **named))

    return run


class SerialPeer:
    """The master's side of a pseudo terminal; a program opens ``device``."""

    def __init__(self) -> None:
        self.fd, self._far = os.openpty()
        tty.setraw(self._far)
        self.device = os.ttyname(self._far)
        self.requests: list[bytes] = []
        self.came_ns: list[int] = []
        self.left_ns: list[int] = []
        self.heard = asyncio.Event()
        asyncio.get_running_loop().add_reader(self.fd, self._read)
        self._closed = False

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            data = os.read(self.fd, 4096)
            self.requests.append(data)
            self.came_ns.append(time.monotonic_ns())
            self.receive_bytes(data)
            self.heard.set()

    def receive_bytes(self, data: bytes) -> None:
        """Handle the bytes received."""

    def send_bytes(self, data: bytes) -> None:
        """Send bytes on the line."""
        self.left_ns.append(time.monotonic_ns())
        os.write(self.fd, data)

    def unplug(self) -> None:
        """Close the line as if the adapter were unplugged."""
        if not self._closed:
            asyncio.get_running_loop().remove_reader(self.fd)
            os.close(self.fd)
            os.close(self._far)
        self._closed = True


class RtuPeer(SerialPeer):
    """Units by number, each with its registers from 0 on; functions 3, 4 and 6.

    ``spoil`` spoils answers, the first of the list the next one; ``busy`` answers with exception 6 so often.
    """

    def __init__(self, units: dict[int, list[int]]) -> None:
        super().__init__()
        self.units = units
        self.spoil: list[Spoil] = []
        self.pause_s = 0.0
        self.written: list[tuple[int, int]] = []

    def receive_bytes(self, data: bytes) -> None:
        """Answer as the addressed unit."""
        unit = data[0]
        if unit not in self.units:
            return
        assert build_frame(unit, data[1:-2]) == data
        function, address, value = struct.unpack(">BHH", data[1:6])
        if function == 6:
            self.written.append((address, value))
            body = data[1:-2]
        elif address + value > len(self.units[unit]):
            body = bytes([function | 0x80, 2])
        else:
            body = struct.pack(f">BB{value}H", function, 2 * value, *self.units[unit][address : address + value])
        pieces = self.spoil.pop(0)(build_frame(unit, body)) if self.spoil else [build_frame(unit, body)]
        for piece in pieces:
            self.send_bytes(piece)


@asynccontextmanager
async def run_rtu_peer(**units: list[int]) -> AsyncIterator[RtuPeer]:
    """Serve units ``u1``, ``u2``... on a pseudo terminal."""
    peer = RtuPeer({int(name[1:]): registers for name, registers in units.items()})
    try:
        yield peer
    finally:
        peer.unplug()
