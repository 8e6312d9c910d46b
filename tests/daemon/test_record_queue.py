"""The queue between machine and pipeline: bounded, in order, with a count of dropped records."""

from __future__ import annotations

import asyncio

from fdhil.daemon.record_queue import RecordQueue
from fdhil.records import Temperature


def reading(tick: int) -> Temperature:
    return Temperature("X", tick, 20.0, "slideway")


async def test_what_finds_no_room_is_refused_and_counted() -> None:
    queue = RecordQueue(3)
    for tick in range(5):
        queue.put(reading(tick))
    assert queue.dropped == 2
    assert [record.tick for record in await queue.batch() if isinstance(record, Temperature)] == [0, 1, 2]
    queue.put(reading(9))
    assert await queue.batch() == [reading(9)]
    assert queue.dropped == 2


async def test_it_is_joined_once_all_is_digested() -> None:
    queue = RecordQueue()
    queue.put(reading(1))
    queue.put(reading(2))
    joined = asyncio.create_task(queue.join())
    batch = await queue.batch()
    await asyncio.sleep(0)
    assert not joined.done()
    queue.digested(len(batch))
    async with asyncio.timeout(60):
        await joined
