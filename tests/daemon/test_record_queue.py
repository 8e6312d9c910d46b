"""The queue between machine and pipeline: bounded, in order, with a count of dropped records."""

from __future__ import annotations

import asyncio

from fdhil.daemon.record_queue import RecordQueue
from fdhil.records import Temperature


def reading(tick: int) -> Temperature:
    return Temperature("X", tick, 20.0, "slideway")


async def test_record_beyond_the_capacity_is_dropped_and_counted() -> None:
    queue = RecordQueue(3)
    for tick in range(5):
        queue.put(reading(tick))
    assert queue.dropped == 2
    assert [record.tick for record in await queue.take_batch() if isinstance(record, Temperature)] == [0, 1, 2]
    queue.put(reading(9))
    assert await queue.take_batch() == [reading(9)]
    assert queue.dropped == 2


async def test_queue_joins_once_all_records_are_processed() -> None:
    queue = RecordQueue()
    queue.put(reading(1))
    queue.put(reading(2))
    joined = asyncio.create_task(queue.join())
    batch = await queue.take_batch()
    await asyncio.sleep(0)
    assert not joined.done()
    queue.mark_processed(len(batch))
    async with asyncio.timeout(60):
        await joined
