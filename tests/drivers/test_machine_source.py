"""A machine's sources run together: what ends one of them ends all, and is never lost."""

from __future__ import annotations

import asyncio
import uuid

import pytest

from fdhil.drivers.bus_source import BusSource
from fdhil.drivers.machine import MachineSource
from fdhil.drivers.sensor_source import Record, Take
from fdhil.records import Notice
from tests.drivers.wire import machine


def source_of() -> MachineSource:
    return MachineSource(machine(bus={"interface": "virtual", "channel": uuid.uuid4().hex}))


async def test_the_exception_that_ends_a_source_leaves_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[Record] = []

    async def run(bus: BusSource, take: Take) -> None:
        take(Notice("BusDown", "MAJOR", f"bus {bus.name}"))
        raise RuntimeError("a fault of the decoder")

    monkeypatch.setattr(BusSource, "run", run)
    with pytest.raises(RuntimeError, match="a fault of the decoder"):
        await source_of().run(said.append)
    assert [record.text for record in said if isinstance(record, Notice)] == ["bus can0"]


async def test_a_taker_that_fails_is_told_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """More records than any queue would have held: there is none in which a failure could wait, or be dropped."""

    async def run(bus: BusSource, take: Take) -> None:
        while True:
            take(Notice("BusDown", "MAJOR", bus.name))
            await asyncio.sleep(0)

    taken = []

    def take(record: Record) -> None:
        taken.append(record)
        if len(taken) == 5000:
            raise ValueError("cannot be taken")

    monkeypatch.setattr(BusSource, "run", run)
    with pytest.raises(ValueError, match="cannot be taken"):
        await source_of().run(take)
    assert len(taken) == 5000
