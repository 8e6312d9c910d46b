"""A machine's sources run together: an error in one of them ends all and is always reported."""

from __future__ import annotations

import asyncio
import time
import uuid
from typing import Any

import can
import pytest

from fdhil.drivers.bus_source import BusSource
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.machine import MachineSource, open_machine
from fdhil.drivers.nc.listener import NcListener
from fdhil.drivers.sensor_source import Record, SensorSource, Take
from fdhil.errors import ConnectError
from fdhil.records import NcState, Notice
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
    """More records than any queue could hold: an error must not wait in a queue or be dropped."""

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


async def test_a_bus_on_which_nothing_is_heard_is_listened_to_and_gets_no_frame() -> None:
    """With the NC off, drives without a heartbeat are silent."""
    settings = machine(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as drive:
        async with open_machine(settings) as source:
            assert source.get_counters()["frames"] == 0
        assert drive.recv(0) is None


@pytest.mark.fault("A29")
def test_silence_from_the_start_is_told_and_so_is_its_end() -> None:
    settings = machine(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    bus = BusSource("can0", settings)
    bus.open()
    try:
        assert bus._bus is not None
        now_ns = bus._bus.last_frame_ns
        assert bus.step(now_ns + 1_900_000_000) == []
        (silent,) = bus.step(now_ns + 2_500_000_000)
        assert isinstance(silent, Notice)
        assert (silent.code, silent.severity) == ("BusSilent", "MAJOR")
        assert "no drive sends a heartbeat (0x1017)" in silent.text
        with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as drive:
            drive.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=False))
            while bus.counters()["frames"] == 0:
                time.sleep(0.001)
        (back,) = bus.step(now_ns)
        assert isinstance(back, Notice)
        assert (back.code, back.severity) == ("BusSilent", "info")
    finally:
        bus.close()


class FailingAtTheEnd:
    """An NC and a sensor whose connections fail while the cancellation closes them."""

    name, axis, samples, lost, connected = "peer", "X", 0, 0, True

    def __init__(self) -> None:
        self.asked = 0
        self.waiting = asyncio.Event()

    async def __aenter__(self) -> FailingAtTheEnd:
        return self

    async def __aexit__(self, *_: object) -> None:
        raise ConnectError(self.name, "went away")

    async def read(self) -> list[NcState]:
        self.asked += 1
        self.waiting.set()
        await asyncio.Event().wait()
        return []

    async def poll(self, _: object) -> list[Record]:
        async with self:
            return [*await self.read()]

    @property
    def link(self) -> FailingAtTheEnd:
        return self

    def fault_code(self, _: object) -> None:
        """Has no effect."""


@pytest.mark.parametrize("what", ["nc", "sensor"])
async def test_source_stops_while_its_connection_fails(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    peer: Any = FailingAtTheEnd()
    monkeypatch.setattr("fdhil.drivers.nc.listener.load_nc_source", lambda name: lambda config: peer)
    source = NcListener(machine()) if what == "nc" else SensorSource(peer, TickClock(0.001))
    running = asyncio.create_task(source.run(lambda record: None))
    await peer.waiting.wait()
    running.cancel()
    await asyncio.wait([running])
    assert (running.cancelled(), peer.asked) == (True, 1)
