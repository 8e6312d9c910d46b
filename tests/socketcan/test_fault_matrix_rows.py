"""Faults of the matrix on a real interface during a cut: the kernel carries each frame to the guard."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable

import pytest

from tests.guard.guard_rig import GuardRig
from tests.guard.simulated_bus import Drive
from tests.socketcan.test_guard import OnAdapter, OnVcan, Wire

pytestmark = pytest.mark.socketcan
Fault = Callable[[GuardRig], None]
RUNNING = ("ACTIVE", "HOLD")


def frame(cob_id: int, data: bytes, times: int = 1) -> Fault:
    return lambda shop: shop.wire.feed([(cob_id, data, 0.0)] * times)


def drive(**changes: object) -> Fault:
    def apply(shop: GuardRig) -> None:
        for name, value in changes.items():
            setattr(shop.drives[0], name, value)

    return apply


def shifted(shop: GuardRig) -> None:
    shop.row += 3


def disarmed(shop: GuardRig) -> None:
    shop._clients[0].send(json.dumps({"request": "disarm"}).encode() + b"\n")


def gone(shop: GuardRig) -> None:
    shop._clients[0].close()


RAMPED: dict[str, tuple[Fault, str]] = {
    "A9": (frame(0x080, b"\x63"), "SyncCollision"),
    "A10": (drive(answers=False), "StaleData"),
    "A15": (frame(0x181, b"\0", times=3), "PdoLength"),
    "A18": (frame(0x281, struct.pack("<Hhh", 0x1237, 0, 9)), "ForeignProducer"),
    "A19": (frame(0x301, struct.pack("<i", 2000)), "OffsetHijack"),
    "A20": (frame(0x081, b"\x30\x81"), "DriveEmergency"),
    "E6": (shifted, "Misaligned"),
    "E9": (drive(mode=1), "NotCsp"),
    "E10": (drive(statusword=0x0250), "DriveNotEnabled"),
    "E11": (drive(statusword=0x1A37), "LimitActive"),
    "E12": (drive(position_error=16500), "FollowingError"),
    "E15": (drive(scale=0.5), "EchoMismatch"),
    "E18": (disarmed, "Disarmed"),
    "F8": (frame(0x764, b"\x05"), "BusLocked"),
    "F15": (gone, "MainLost"),
}
FROZEN: dict[str, tuple[Fault, str]] = {
    "A23": (frame(0x701, b"\0"), "NodeRebooted"),
    "A24": (frame(0x000, b"\x80\x00"), "NmtStateWrong"),
}


def suffer(shop: GuardRig, fault: Fault) -> list[str]:
    for _ in range(200):
        if shop.state not in RUNNING:
            break
        fault(shop)
        shop.cycle()
    assert shop.state not in RUNNING
    shop.drives = [Drive(d.node_id, queue=d.queue, offset=d.offset) for d in shop.drives]
    for _ in range(400):
        if shop.state in ("OFF", "FROZEN"):
            break
        shop.cycle()
    return [str(event["code"]) for event in shop.events() if event["event"] == "state" and event.get("code")]


def sends_nothing_more(shop: GuardRig) -> None:
    sent = len(shop.wire.sent)
    shop.run(50)
    assert len(shop.wire.sent) == sent


@pytest.mark.fault("A9", "A10", "A15", "A18", "A19", "A20", "E6", "E9", "E10", "E11", "E12", "E15", "E18", "F8", "F15")
@pytest.mark.parametrize("row", RAMPED)
def test_fault_ends_at_zero(make: Callable[[type[Wire]], GuardRig], row: str) -> None:
    shop = make(OnVcan)
    shop.into_the_cut()
    fault, code = RAMPED[row]
    assert code in suffer(shop, fault)
    assert shop.state == "OFF"
    assert shop.offsets()[-1] == 0
    sends_nothing_more(shop)


@pytest.mark.fault("A23", "A24")
@pytest.mark.parametrize("row", FROZEN)
def test_fault_freezes_and_stops_sending(make: Callable[[type[Wire]], GuardRig], row: str) -> None:
    shop = make(OnVcan)
    shop.into_the_cut()
    fault, code = FROZEN[row]
    assert code in suffer(shop, fault)
    assert shop.state == "FROZEN"
    sends_nothing_more(shop)


@pytest.mark.fault("A21")
def test_flood_of_emergencies_is_one_ramp_down(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnVcan)
    shop.into_the_cut()

    def flood(shop: GuardRig) -> None:
        shop.wire.feed([(0x081, struct.pack("<H6x", 0x3000 + k), 0.0) for k in range(200)])

    assert suffer(shop, flood).count("DriveEmergency") <= 2
    assert (shop.state, shop.offsets()[-1]) == ("OFF", 0)


@pytest.mark.fault("A2")
def test_passive_controller_ramps_down(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnAdapter)
    shop.into_the_cut()
    wire = shop.wire
    assert isinstance(wire, OnAdapter)
    wire.adapter.say("sp130000")
    assert "ErrorPassive" in suffer(shop, lambda _: None)
    assert (shop.state, shop.offsets()[-1]) == ("OFF", 0)


@pytest.mark.fault("E13")
def test_offset_of_a_drive_at_start_is_adopted(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnVcan)
    shop.drives[0].hold(-500)
    for _ in range(500):
        shop.cycle()
        if shop.wire.sent and shop.state == "OFF":
            break
    first, last = shop.offsets()[0], shop.offsets()[-1]
    assert abs(first + 500) <= shop.settings.axes[0].limits.rate
    assert (shop.state, last, shop.drives[0].offset) == ("OFF", 0, 0)
    assert "StaleOffset" in {str(event.get("code")) for event in shop.events()}


@pytest.mark.fault("A11")
def test_duplicate_frames_change_nothing(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnVcan)
    shop.into_the_cut()
    for _ in range(50):
        shop.cycle()
        shop.wire.feed([(0x281, struct.pack("<Hhh", 0x1237, 0, 0), 0.0)])
    assert shop.state == "ACTIVE"


@pytest.mark.fault("G9")
def test_forged_read_backs_move_nothing(make: Callable[[type[Wire]], GuardRig]) -> None:
    shop = make(OnVcan)
    for value in (300, 983_040, -983_040):
        shop.wire.feed([(0x381, struct.pack("<ii", value, value), 0.0)])
        shop.run(40)
    assert shop.wire.sent == []
