"""A stream of received bytes with their times: common to all kinds of line."""

import asyncio
import time
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass

from fdhil.errors import ConnectError

MOST_KEPT = 1 << 16  # unread bytes; the oldest are discarded


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes that were read together, and when (host-monotonic ns): the first ones had arrived earlier."""

    data: bytes
    t_ns: int


class ByteStream(ABC):
    """A line that is open or not; ``last_ns`` (host-monotonic) is when bytes came last, ``dropped`` counts discarded
    ones."""

    where: str
    character_s: float

    def __init__(self) -> None:
        self._chunks: deque[Chunk] = deque()
        self._kept = 0
        self._came = asyncio.Event()
        self._gone = ""
        self.dropped = 0
        self.last_ns = 0

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether the line is open and still there."""

    @abstractmethod
    async def connect(self, name: str, timeout_s: float) -> None:
        """Open the line; ConnectError. ``name`` is the sensor's, for messages."""

    @abstractmethod
    def send(self, name: str, data: bytes) -> int:
        """Write at once and return when (host-monotonic ns); ConnectError when the line is gone or accepts nothing."""

    @abstractmethod
    def close(self) -> None:
        """Close the line."""

    def compute_wire_ns(self, count: int) -> int:
        """Return the time that ``count`` characters take on the wire."""
        return round(count * self.character_s * 1e9)

    async def receive_chunk(self, name: str, until_ns: int) -> Chunk | None:
        """Return the next bytes, None when none have come by ``until_ns``; ConnectError when the line is gone."""
        while not self._chunks:
            if not self.is_open:
                raise self._make_gone_error(name)
            self._came.clear()
            try:
                async with asyncio.timeout((until_ns - time.monotonic_ns()) / 1e9):
                    await self._came.wait()
            except TimeoutError:
                if not self._chunks:
                    return None
        chunk = self._chunks.popleft()
        self._kept -= len(chunk.data)
        return chunk

    def discard_input(self) -> int:
        """Discard received bytes; return their number."""
        kept, self._kept = self._kept, 0
        self._chunks.clear()
        return kept

    def _store_bytes(self, data: bytes) -> None:
        self.last_ns = time.monotonic_ns()
        self._chunks.append(Chunk(data, self.last_ns))
        self._kept += len(data)
        while self._kept > MOST_KEPT:
            self.dropped += len(self._chunks[0].data)
            self._kept -= len(self._chunks.popleft().data)
        self._came.set()

    def _end_stream(self, why: str) -> None:
        self._gone = why
        self._came.set()

    def _make_gone_error(self, name: str) -> ConnectError:
        why = self._gone or "it is not open"
        return ConnectError(name, f"{self.where} is gone ({why}); check the adapter and its cable")
