"""The drives as any CANopen master sees them, on every transport."""

from __future__ import annotations

import queue
import struct
import time
from collections.abc import Collection, Iterator

import can
import canopen
import pytest

from fdhil.sim.drive.operation_modes import CYCLIC_POSITION
from fdhil.sim.nc.drive_link import PdoWiring
from tests.integration.conftest import Bench

PATIENCE_S = 100.0


@pytest.fixture
def bus(bench: Bench) -> Iterator[can.BusABC]:
    joined = bench.join()
    yield joined
    joined.shutdown()


def next_of(bus: can.BusABC, can_ids: Collection[int]) -> tuple[int, bytes]:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        message = bus.recv(0.1)
        if message is not None and message.arbitration_id in can_ids:
            return message.arbitration_id, bytes(message.data)
    raise AssertionError(f"no frame {' or '.join(f'{can_id:03X}' for can_id in can_ids)} came")


def received(bus: can.BusABC, can_id: int) -> bytes:
    return next_of(bus, (can_id,))[1]


def send(bus: can.BusABC, can_id: int, data: bytes = b"") -> None:
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def test_stock_client_reads_and_writes_by_every_sdo_transfer(bench: Bench) -> None:
    bus = bench.join()
    network = canopen.Network(bus=bus)
    network.connect()
    try:
        node = network.add_node(1, bench.ready["drives"]["X"]["eds"])
        node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
        assert node.sdo[0x1018][1].raw > 0
        assert len(str(node.sdo[0x1008].raw)) > 4
        network.nmt.state = "OPERATIONAL"
        answers: queue.Queue[int] = queue.Queue()
        network.subscribe(0x181, lambda can_id, _data, _stamp: answers.put(can_id))
        for _ in range(200):
            send(bus, 0x080)
            answers.get(timeout=PATIENCE_S)
        with node.sdo[0x2120].open("rb", block_transfer=True) as stream:
            assert len(stream.read()) > 1000  # the trace of those cycles
        with pytest.raises(canopen.SdoAbortedError) as aborted:
            node.sdo.download(0x6041, 0, b"\0\0")
        assert aborted.value.code == 0x06010002
        node.sdo[0x60B0].raw = -1234
        assert node.sdo[0x60B0].raw == -1234
    finally:
        network.disconnect()
        bus.shutdown()


def test_reset_node_boots_and_can_be_started(bus: can.BusABC) -> None:
    send(bus, 0x000, bytes([0x81, 1]))
    while received(bus, 0x701) != b"\x00":  # heartbeats may come before it
        pass
    send(bus, 0x000, bytes([0x01, 1]))
    send(bus, 0x080)
    assert len(received(bus, 0x181)) == 8
    assert len(received(bus, 0x281)) >= 6


def test_nc_takeover_from_another_thread_is_complete(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    of_axis = bench.service.machine.nc._wiring

    def slow(axis: str) -> PdoWiring:
        time.sleep(0.1)
        return of_axis(axis)

    monkeypatch.setattr(bench.service.machine.nc, "_wiring", slow)
    bench.command('{"command": "nc", "on": true}')
    bench.event("nc")
    modes = [unit.drive.dictionary.get_number(0x6060) for unit in bench.service.machine.units.values()]
    assert modes == [CYCLIC_POSITION] * 2


def test_command_to_an_ended_machine_returns(bench: Bench) -> None:
    bench.service.stop()
    bench.command('{"command": "nc", "on": true}')
    assert bench.events.empty()


def test_foreign_master_set_point_acts_two_cycles_later(bus: can.BusABC) -> None:
    send(bus, 0x000, bytes([0x01, 1]))
    send(bus, 0x601, struct.pack("<BHBI", 0x2F, 0x6060, 0, 8))
    received(bus, 0x581)
    status = 0
    for word in (0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F, 0x0F):
        send(bus, 0x201, struct.pack("<Hi", word, 0))
        send(bus, 0x080)
        status = struct.unpack_from("<H", received(bus, 0x281))[0]
    assert status & 0x6F == 0x27
    demands = []
    for k in range(60):
        send(bus, 0x201, struct.pack("<Hi", 0x0F, 10 * k))
        send(bus, 0x080)
        while (frame := next_of(bus, (0x281, 0x381)))[0] == 0x381:  # it comes behind 281, every tenth SYNC
            demands.append((k - 1, struct.unpack("<ii", frame[1])[0]))
    assert len(demands) >= 5
    # the target latched at SYNC k is in force at SYNC k + 2
    assert {demand - 10 * (k - 2) for k, demand in demands} == {0}
