"""A Modbus TCP voltage sensor that builds its own frames, so that it can produce every fault."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

VOLTS_PER_COUNT = 0.01


class SensorPeer:
    """Samples at ``rate_hz`` of its own clock, value = counter % 1000; ``mode`` says how it answers.

    ``served``: registers that it has instead, always the same, for a sensor with another map.
    """

    def __init__(self, rate_hz: float = 1000.0) -> None:
        self.rate_hz = rate_hz
        self.mode = "good"
        self.start = time.monotonic() - 0.05  # a client finds samples, however early it asks
        self.latched = 0
        self.block: list[int] = []
        self.status = 0
        self.requests = 0
        self.frozen_at: int | None = None
        self.port = 0
        self.served: Sequence[int] = ()
        self.other_unit = 0
        self.connections: dict[asyncio.StreamWriter, asyncio.Event] = {}

    @property
    def newest(self) -> int:
        """Return the counter of the newest complete sample."""
        if self.frozen_at is not None:
            return self.frozen_at
        return int((time.monotonic() - self.start) * self.rate_hz) - 1

    def latch_samples(self) -> None:
        newest = self.newest
        fresh = newest + 1 - self.latched
        self.status = 2 if fresh > 100 else 1
        count = min(fresh, 100)
        self.block = list(range(newest + 1 - count, newest + 1))
        self.latched = newest + 1

    def build_registers(self) -> list[int]:
        first = self.block[0] if self.block else self.latched
        head = struct.pack(">fIfff", 1.0, max(self.newest, 0), self.rate_hz, VOLTS_PER_COUNT, 21.5)
        words = list(struct.unpack(">10H", head))
        words += [0, self.status, *struct.unpack(">2H", struct.pack(">I", first)), len(self.block), 0]
        words += [counter % 1000 for counter in self.block]
        return words + [0] * (116 - len(words))

    def answer_request(self, request: bytes) -> bytes:
        function, address, value = struct.unpack(">BHH", request[:5])
        if self.mode == "exception":
            return bytes([function | 0x80, 2])
        if self.mode == "nonsense":
            return bytes([0x1A, 1, 2])
        if self.mode == "other function":
            return struct.pack(">BB", function ^ 7, 2 * value) + bytes(2 * value)
        if self.mode == "busy":
            return bytes([function | 0x80, 6])
        if function == 6:
            self.latch_samples()
            return request
        words = list(self.served or self.build_registers())[address : address + value]
        if self.mode == "short":
            words = words[:-2]
        if self.mode == "nan":
            words[4:6] = [0x7FC0, 0]
        if self.mode == "too many":
            words[14] = 101
        return struct.pack(f">BB{len(words)}H", function, 2 * len(words), *words)

    async def serve_requests(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections[writer] = asyncio.Event()
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                transaction, _, length, unit = struct.unpack(">HHHB", await reader.readexactly(7))
                request = await reader.readexactly(length - 1)
                self.requests += 1
                if self.mode == "silent":
                    continue
                if self.mode == "hang up":
                    break
                body = self.answer_request(request)
                if self.mode == "other unit":
                    unit = self.other_unit
                writer.write(struct.pack(">HHHB", transaction, 0, len(body) + 1, unit) + body)
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()
        self.connections[writer].set()


@asynccontextmanager
async def run_sensor_peer(rate_hz: float = 1000.0) -> AsyncIterator[SensorPeer]:
    """Serve a sensor on a free port of the loopback."""
    peer = SensorPeer(rate_hz)
    server = await asyncio.start_server(peer.serve_requests, "127.0.0.1", 0)
    peer.port = int(server.sockets[0].getsockname()[1])
    try:
        yield peer
    finally:
        server.close()
        for writer, ended in peer.connections.items():
            writer.close()
            await ended.wait()
        await server.wait_closed()
