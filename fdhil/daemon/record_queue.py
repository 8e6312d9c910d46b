"""Holds the records of one axis between the machine and its pipeline: the only queue on that way.

Its policy is that of a bus' ring of frames: what finds no room is refused and counted, nothing waits, and what was
taken in is digested in order. How a source ended is in no queue: it is the exception that leaves the source.
"""

from __future__ import annotations

import asyncio

from fdhil.pipeline import Record

CAPACITY = 4000  # more than half a minute of blocks


class RecordQueue:
    """Records that wait, at most ``capacity``; ``dropped`` counts those that were refused."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._queue = asyncio.Queue[Record](capacity)
        self.dropped = 0

    def put(self, record: Record) -> None:
        """Take a record in, or refuse it."""
        if self._queue.full():
            self.dropped += 1
        else:
            self._queue.put_nowait(record)

    async def batch(self) -> list[Record]:
        """Return all that waits, once there is anything."""
        records = [await self._queue.get()]
        while not self._queue.empty():
            records.append(self._queue.get_nowait())
        return records

    def digested(self, records: int) -> None:
        """So many of those that were returned have been dealt with."""
        for _ in range(records):
            self._queue.task_done()

    async def join(self) -> None:
        """Wait until all that was taken in has been dealt with."""
        await self._queue.join()
