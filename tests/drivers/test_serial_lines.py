"""Lines of text over a pseudo terminal, split at any place."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from fdhil.config.sensor_sections import SerialDevice
from fdhil.drivers.serial.serial_port import SerialPort
from fdhil.drivers.serial.text_lines import LONGEST, LineReader
from fdhil.errors import ConnectError
from tests.drivers.serial_peer import SerialPeer


def compute_deadline_ns() -> int:
    return time.monotonic_ns() + 60_000_000_000  # nothing here is waited for in vain


@asynccontextmanager
async def run_line_reader() -> AsyncIterator[tuple[SerialPeer, SerialPort, LineReader]]:
    peer = SerialPeer()
    port = SerialPort(SerialDevice(device=peer.device, baud_rate=115200))
    port.open("meter")
    try:
        yield peer, port, LineReader(port, "meter")
    finally:
        port.close()
        peer.unplug()


async def test_lines_are_split_at_any_line_end_and_chunk_border() -> None:
    async with run_line_reader() as (peer, _, lines):
        before = time.monotonic_ns()
        for piece in (b"+1.5", b" V\r\n\r\n-2", b".5 V\r3 V\n4"):
            peer.send_bytes(piece)
        found = [await lines.read_line(compute_deadline_ns()) for _ in range(3)]
        assert [line and line.text for line in found] == ["+1.5 V", "-2.5 V", "3 V"]
        assert all(line is not None and before <= line.t_ns <= time.monotonic_ns() for line in found)
        assert await lines.read_line(time.monotonic_ns()) is None
        peer.send_bytes(b"2\n")
        last = await lines.read_line(compute_deadline_ns())
        assert last is not None
        assert last.text == "42"


async def test_overlong_line_is_discarded() -> None:
    async with run_line_reader() as (peer, _, lines):
        for _ in range(3):
            peer.send_bytes(b"x" * LONGEST)
        peer.send_bytes(b"\n5\n")
        texts: list[str] = []
        while not texts or texts[-1] != "5":
            line = await lines.read_line(compute_deadline_ns())
            assert line is not None
            texts.append(line.text)
        assert lines.overlong
        assert all(len(text) <= LONGEST for text in texts)


async def test_lost_port_is_an_error_not_an_endless_loop() -> None:
    async with run_line_reader() as (peer, port, lines):
        peer.unplug()
        with pytest.raises(ConnectError, match="check the adapter and its cable"):
            await lines.read_line(compute_deadline_ns())
        assert not port.is_open
        with pytest.raises(ConnectError):
            port.send("meter", b"x")
