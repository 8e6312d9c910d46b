"""Queues the records of one axis between the machine and its pipeline: the only queue on that way.

It works like a bus' ring of frames: a record that does not fit is dropped and counted, nothing waits, and queued
records are processed in order. The end of a source is not queued: it is the exception that leaves the source.
"""

import asyncio

from fdhil.pipeline import Record

CAPACITY = 4000  # more than half a minute of blocks


class RecordQueue:
    """At most ``capacity`` waiting records; ``dropped`` counts those that did not fit."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._queue = asyncio.Queue[Record](capacity)
        self.dropped = 0

    def put(self, record: Record) -> None:
        """Queue a record, or drop and count it."""
        if self._queue.full():
            self.dropped += 1
        else:
            self._queue.put_nowait(record)

    async def take_batch(self) -> list[Record]:
        """Return all waiting records, once there are any."""
        records = [await self._queue.get()]
        while not self._queue.empty():
            records.append(self._queue.get_nowait())
        return records

    def mark_processed(self, records: int) -> None:
        """Note that this number of returned records was processed."""
        for _ in range(records):
            self._queue.task_done()

    async def join(self) -> None:
        """Wait until all queued records were processed."""
        await self._queue.join()
