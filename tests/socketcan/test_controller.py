"""A controller that counts errors, goes off and is unplugged: real error frames of the kernel's slcan driver."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest

from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import CanBus as BusSettings
from fdhil.drivers.can.bus_listener import ListeningBus
from fdhil.drivers.can.error_frames import ErrorFrameMonitor
from fdhil.errors import DeviceError
from fdhil.guard.can_socket import ERROR, BusDown, RawCan
from tests.socketcan.interface import CAN_FRAME, SerialAdapter, raw_socket, send, set_up

pytestmark = pytest.mark.socketcan
SAID = [
    ("sw096000", [("ErrorPassive", "minor")]),
    ("sp130000", [("ErrorPassive", "MAJOR")]),
    ("e1a", [("NotAcknowledged", "minor"), ("BusErrors", "minor")]),
    ("e2sf", []),  # damage again: it is known
    ("e1o", [("RxOverflow", "minor")]),
    ("sb255000", [("BusOff", "MAJOR")]),
]


@pytest.fixture
def adapter() -> Iterator[SerialAdapter]:
    with SerialAdapter() as running:
        yield running


def settings_of(adapter: SerialAdapter) -> BusSettings:
    return BusSettings(interface="socketcan", channel=adapter.channel)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_each_controller_state_and_error_is_reported(adapter: SerialAdapter) -> None:
    watch, received = ErrorFrameMonitor(), 0
    with ListeningBus("can0", settings_of(adapter)) as bus:
        for line, expected in SAID:
            adapter.say(line)
            received += 1
            wait_for(lambda: bus.read_counters()["frames"] >= received)  # noqa: B023 - it is asked now
            notices = watch.watch_frames(bus.drain_frames(), time.monotonic_ns())
            assert [(notice.code, notice.severity) for notice in notices] == expected, line
    assert watch.count == len(SAID)


@pytest.mark.fault("A4")
def test_unplugged_controller_ends_the_bus(adapter: SerialAdapter) -> None:
    with ListeningBus("can0", settings_of(adapter)) as bus:
        adapter.say("t1812AABB")
        wait_for(lambda: bus.read_counters()["frames"] == 1)
        adapter.unplug()
        wait_for(lambda: bus.end_reason is not None)
        assert "is down or gone" in str(bus.end_reason)


def test_full_transmit_queue_is_reported_at_once(adapter: SerialAdapter) -> None:
    def pour(bus: TransmitBus) -> None:
        for _ in range(100_000):
            bus.send(0x601, bytes(8))

    with TransmitBus("can0", settings_of(adapter)) as bus, pytest.raises(DeviceError, match="no other node acknow"):
        pour(bus)


def test_guard_sees_controller_states_and_drops_frames_on_a_full_queue(adapter: SerialAdapter) -> None:
    can = RawCan(raw_socket(adapter.channel), allowed={0x301}, wanted={0x080})
    try:
        assert not all(can.send(0x301, bytes(4)) for _ in range(100_000))
        for line in ("sw096000", "sp130000", "sb255000"):
            adapter.say(line)
        states: list[bytes] = []

        def is_off() -> bool:
            states.extend(data for cob_id, data, _ in can.receive() if cob_id == ERROR)
            return b"off" in states

        wait_for(is_off)
        assert states == [b"warning", b"passive", b"off"]
        adapter.unplug()
        with pytest.raises(BusDown):
            wait_for(lambda: can.receive() is None)
    finally:
        can.close()


def test_guard_socket_recovers_with_the_interface() -> None:
    can = RawCan(raw_socket(), allowed={0x301}, wanted={0x080})
    try:
        for _ in range(3):
            with raw_socket() as other:
                send(other, 1, 0x080)
            set_up("vcan0", False)
            with pytest.raises(BusDown):
                can.receive()
            with pytest.raises(BusDown):
                can.send(0x301, bytes(4))
            assert not can.try_restore()
            set_up("vcan0", True)
            assert can.try_restore()
            assert can.receive() == []  # what came before is no news
            with raw_socket() as other:
                send(other, 2, 0x080)
                send(other, 2, 0x081)
                assert [(cob_id, data[0]) for cob_id, data, _ in can.receive()] == [(0x080, 2)]
                assert can.send(0x301, b"\1\2\3\4")
                assert CAN_FRAME.unpack(other.recv(16)) == (0x301, 4, b"\1\2\3\4\0\0\0\0")
    finally:
        set_up("vcan0", True)
        can.close()


def test_guard_socket_recovers_after_the_adapter_is_plugged_in_again() -> None:
    with SerialAdapter() as first:
        channel = first.channel
        can = RawCan(raw_socket(channel), allowed={0x301}, wanted={0x080})
    try:
        with pytest.raises(BusDown):
            can.receive()
        assert not can.try_restore()
        with SerialAdapter() as second:
            assert second.channel == channel
            assert can.try_restore()
            second.say("t0801FF")
            wait_for(lambda: any(cob_id == 0x080 for cob_id, _, _ in can.receive()))
    finally:
        can.close()
