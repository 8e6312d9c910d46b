"""Lines of text over a pseudo terminal, split at any place."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from fdhil.config.sensors import SerialPlace
from fdhil.drivers.serial.lines import LONGEST, LineReader
from fdhil.drivers.serial.port import SerialPort
from fdhil.errors import ConnectError
from tests.drivers.serial_peer import SerialPeer


def soon() -> int:
    return time.monotonic_ns() + 60_000_000_000  # nothing here is waited for in vain


@asynccontextmanager
async def reader() -> AsyncIterator[tuple[SerialPeer, SerialPort, LineReader]]:
    peer = SerialPeer()
    port = SerialPort(SerialPlace(device=peer.device, baud_rate=115200))
    port.open("meter")
    try:
        yield peer, port, LineReader(port, "meter")
    finally:
        port.close()
        peer.unplug()


async def test_lines_are_cut_whatever_ends_them_and_however_they_come() -> None:
    async with reader() as (peer, _, lines):
        before = time.monotonic_ns()
        for piece in (b"+1.5", b" V\r\n\r\n-2", b".5 V\r3 V\n4"):
            peer.put(piece)
        found = [await lines.next_line(soon()) for _ in range(3)]
        assert [line and line.text for line in found] == ["+1.5 V", "-2.5 V", "3 V"]
        assert all(line is not None and before <= line.t_ns <= time.monotonic_ns() for line in found)
        assert await lines.next_line(time.monotonic_ns()) is None
        peer.put(b"2\n")
        last = await lines.next_line(soon())
        assert last is not None
        assert last.text == "42"


async def test_what_never_ends_is_let_go() -> None:
    async with reader() as (peer, _, lines):
        for _ in range(3):
            peer.put(b"x" * LONGEST)
        peer.put(b"\n5\n")
        texts: list[str] = []
        while not texts or texts[-1] != "5":
            line = await lines.next_line(soon())
            assert line is not None
            texts.append(line.text)
        assert lines.overlong
        assert all(len(text) <= LONGEST for text in texts)


async def test_a_port_that_is_gone_is_an_error_and_not_a_loop() -> None:
    async with reader() as (peer, port, lines):
        peer.unplug()
        with pytest.raises(ConnectError, match="check the adapter and its cable"):
            await lines.next_line(soon())
        assert not port.is_open
        with pytest.raises(ConnectError):
            port.send("meter", b"x")
