"""The guard on real interfaces during a cut: interface down, full queue, bus-off."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import pytest

from fdhil.guard.can_socket import Frame, RawCan
from fdhil.guard.frame_monitor import FrameMonitor
from tests.guard.guard_rig import TOKEN, GuardRig
from tests.guard.simulated_bus import commissioned, settings
from tests.socketcan.interface import CAN_FRAME, SerialAdapter, raw_socket, set_up

pytestmark = pytest.mark.socketcan
DELIVERY_S = 0.5  # from the line to the sockets, on a host that is busy
WANTED = FrameMonitor(commissioned(settings())).list_received_ids()


class Wire(RawCan):
    def __init__(self, allowed: frozenset[int], channel: str) -> None:
        super().__init__(raw_socket(channel), allowed, WANTED)
        self.sent: list[tuple[int, bytes]] = []

    def feed(self, frames: Sequence[Frame]) -> None:
        raise NotImplementedError

    def _send(self, cob_id: int, data: bytes) -> bool:
        left = super()._send(cob_id, data)
        self.sent.append((cob_id, data))
        return left


class OnVcan(Wire):
    def __init__(self, allowed: frozenset[int]) -> None:
        super().__init__(allowed, "vcan0")

    def feed(self, frames: Sequence[Frame]) -> None:
        with raw_socket() as others:
            for cob_id, data, _ in frames:
                others.send(CAN_FRAME.pack(cob_id, len(data), data))


class OnAdapter(Wire):
    def __init__(self, allowed: frozenset[int]) -> None:
        self.adapter = SerialAdapter()
        self.stuck = False
        self._left = 0
        self._ear = raw_socket(self.adapter.channel)
        self._ear.settimeout(DELIVERY_S)
        super().__init__(allowed, self.adapter.channel)

    def feed(self, frames: Sequence[Frame]) -> None:
        for cob_id, data, _ in frames:
            self.adapter.say(f"t{cob_id:03X}{len(data)}{data.hex().upper()}")
        self._wait_for_frame(*frames[-1][:2])
        while not self.stuck and self._left < len(self.sent):  # it leaves by a thread of the line discipline's own
            left = self.adapter.drain(DELIVERY_S)
            self._left = self._left + left if left else len(self.sent)  # what left while nobody waited is not counted

    def _wait_for_frame(self, cob_id: int, data: bytes) -> None:
        last = CAN_FRAME.pack(cob_id, len(data), data)
        with contextlib.suppress(TimeoutError):
            while self._ear.recv(CAN_FRAME.size) != last:
                pass

    def close(self) -> None:
        super().close()
        self._ear.close()
        self.adapter.unplug()


def until(shop: GuardRig, condition: Callable[[], bool], act: Callable[[], None]) -> None:
    for _ in range(20_000):
        if condition():
            return
        act()
    raise AssertionError(shop.events()[-5:])


def events(shop: GuardRig, name: str) -> int:
    return sum(event["event"] == name for event in shop.events())


@pytest.mark.fault("A4")
def test_interface_down_freezes_and_the_offset_is_adopted_on_return(
    make: Callable[[type[Wire]], GuardRig],
) -> None:
    shop = make(OnVcan)
    client = shop.into_the_cut()
    set_up("vcan0", False)
    until(shop, lambda: shop.state == "FROZEN", shop.turn)
    assert shop.guard.state.cause is not None
    assert shop.guard.state.cause.code == "BusDown"
    sent = len(shop.wire.sent)
    for _ in range(20):
        shop.turn()
    assert events(shop, "bus_restored") == 0
    set_up("vcan0", True)
    until(shop, lambda: events(shop, "bus_restored") == 1, shop.turn)
    shop.playing = False
    shop.run(50)
    assert (shop.state, len(shop.wire.sent)) == ("FROZEN", sent)
    assert shop.ask(client, {"request": "adopt", "token": TOKEN})["ok"]
    until(shop, lambda: shop.state == "OFF", shop.cycle)
    assert shop.offsets()[-1] == 0


@pytest.mark.fault("A1")
def test_bus_off_freezes(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnAdapter)
    shop.into_the_cut()
    wire = shop.wire
    assert isinstance(wire, OnAdapter)
    wire.adapter.say("sb255000")
    until(shop, lambda: shop.state == "FROZEN", shop.cycle)
    assert shop.guard.state.cause is not None
    assert shop.guard.state.cause.code == "BusOff"
    sent = len(wire.sent)
    shop.run(50)
    assert len(wire.sent) == sent


@pytest.mark.fault("A5")
def test_full_queue_ramps_down_then_freezes(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnAdapter)
    shop.into_the_cut()
    wire = shop.wire
    assert isinstance(wire, OnAdapter)
    wire.stuck = True
    until(shop, lambda: shop.state == "FROZEN", shop.cycle)
    codes = [event.get("code") for event in shop.events() if event["event"] == "state"]
    assert codes[-2:] == ["TxQueueFull", "TxQueueFull"]
    sent = len(wire.sent)
    shop.run(50)
    assert len(wire.sent) == sent
