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
from fdhil.drivers.machine_source import MachineSource, open_machine
from fdhil.drivers.nc.nc_listener import NcListener
from fdhil.drivers.sensor_source import Record, SensorSource, Take
from fdhil.errors import ConnectError
from fdhil.records import NcState, Notice
from tests.drivers.frame_builder import build_machine_config


def create_source() -> MachineSource:
    return MachineSource(build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex}))


async def test_exception_of_a_source_is_raised_by_the_machine_source(monkeypatch: pytest.MonkeyPatch) -> None:
    message: list[Record] = []

    async def run(bus: BusSource, take: Take) -> None:
        take(Notice("BusDown", "MAJOR", f"bus {bus.name}"))
        raise RuntimeError("a fault of the decoder")

    monkeypatch.setattr(BusSource, "run", run)
    with pytest.raises(RuntimeError, match="a fault of the decoder"):
        await create_source().run(message.append)
    assert [record.text for record in message if isinstance(record, Notice)] == ["bus can0"]


async def test_failing_consumer_ends_the_machine_source(monkeypatch: pytest.MonkeyPatch) -> None:
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
        await create_source().run(take)
    assert len(taken) == 5000


async def test_silent_bus_is_opened_and_receives_no_frame_from_us() -> None:
    """With the NC off, drives without a heartbeat are silent."""
    settings = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as drive:
        async with open_machine(settings) as source:
            assert source.get_counters()["frames"] == 0
        assert drive.recv(0) is None


@pytest.mark.fault("A29")
def test_initial_bus_silence_and_its_end_are_reported() -> None:
    settings = build_machine_config(bus={"interface": "virtual", "channel": uuid.uuid4().hex})
    bus = BusSource("can0", settings)
    bus.open()
    try:
        assert bus._bus is not None
        now_ns = bus._bus.last_frame_ns
        assert bus.process_frames(now_ns + 1_900_000_000) == []
        (silent,) = bus.process_frames(now_ns + 2_500_000_000)
        assert isinstance(silent, Notice)
        assert (silent.code, silent.severity) == ("BusSilent", "MAJOR")
        assert "no drive sends a heartbeat (0x1017)" in silent.text
        with can.Bus(interface="virtual", channel=settings.bus["can0"].channel) as drive:
            drive.send(can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=False))
            while bus.read_counters()["frames"] == 0:
                time.sleep(0.001)
        (back,) = bus.process_frames(now_ns)
        assert isinstance(back, Notice)
        assert (back.code, back.severity) == ("BusSilent", "info")
    finally:
        bus.close()


class SensorFailingAtTheEnd:
    """An NC and a sensor whose connections fail while the cancellation closes them."""

    name, axis, samples, lost, is_connected = "peer", "X", 0, 0, True

    def __init__(self) -> None:
        self.asked = 0
        self.waiting = asyncio.Event()

    async def __aenter__(self) -> SensorFailingAtTheEnd:
        return self

    async def __aexit__(self, *_: object) -> None:
        raise ConnectError(self.name, "went away")

    async def read_states(self) -> list[NcState]:
        self.asked += 1
        self.waiting.set()
        await asyncio.Event().wait()
        return []

    async def poll_samples(self, _: object) -> list[Record]:
        async with self:
            return [*await self.read_states()]

    @property
    def link(self) -> SensorFailingAtTheEnd:
        return self

    def classify_fault(self, _: object) -> None:
        """Has no effect."""


@pytest.mark.parametrize("what", ["nc", "sensor"])
async def test_source_stops_while_its_connection_fails(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    peer: Any = SensorFailingAtTheEnd()
    monkeypatch.setattr("fdhil.drivers.nc.nc_listener.load_nc_source", lambda name: lambda config: peer)
    source = NcListener(build_machine_config()) if what == "nc" else SensorSource(peer, TickClock(0.001))
    running = asyncio.create_task(source.run(lambda record: None))
    await peer.waiting.wait()
    running.cancel()
    await asyncio.wait([running])
    assert (running.cancelled(), peer.asked) == (True, 1)
