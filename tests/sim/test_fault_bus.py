"""Frame faults: each kind acts as defined and is counted, over any python-can bus, reproducibly by its seed."""

from __future__ import annotations

import errno
import threading
import uuid
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import can
import canopen
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.frame_faults import VALUES, FrameFault, FrameFaults, PlannedBusError, Way
from fdhil.sim.frame_types import Frame
from fdhil.sim.wire.fault_bus import FaultBus
from tests.sim.canopen_peer import load_dictionary
from tests.sim.drive_rig import build_machine_config


def build_cycles(first: int, last: int) -> list[Frame]:
    """Return SYNC k followed by a frame with k."""
    return [frame for k in range(first, last) for frame in ((0x80, bytes([k % 240 + 1])), (0x181, bytes([k, 0])))]


def pass_frames(faults: FrameFaults, frames: list[Frame], way: Way = "received") -> list[Frame]:
    return [frame for each in frames for frame, _ in faults.process_frame(each, way, 0.0)]


def list_numbers(frames: list[Frame]) -> list[int]:
    return [data[0] for can_id, data in frames if can_id == 0x181]


def apply_plan(kind: str, value: float = 1, **more: Any) -> FrameFault:
    return FrameFault(kind, value, **{"can_ids": {0x181}} | more)


@pytest.mark.parametrize(
    ("fault", "left", "counted"),
    [
        (apply_plan("drop", from_sync=2, until_sync=5), [0, 1, 5, 6, 7], 3),
        (apply_plan("drop", times=2), [2, 3, 4, 5, 6, 7], 2),
        (apply_plan("drop", way="sent"), [*range(8)], 0),
        (apply_plan("drop", can_ids={0x182}), [*range(8)], 0),
        (apply_plan("duplicate", 2, from_sync=6), [*range(6), 6, 6, 6, 7, 7, 7], 2),
        (apply_plan("delay", 2, from_sync=3, until_sync=4), [0, 1, 2, 4, 3, 5, 6, 7], 1),
        (apply_plan("truncate", 1, from_sync=7), [*range(8)], 1),
    ],
)
def test_fault_affects_only_named_frames(fault: FrameFault, left: list[int], counted: int) -> None:
    faults = FrameFaults([fault])
    assert list_numbers(pass_frames(faults, build_cycles(0, 8))) == left
    assert faults.total(fault.kind) == faults.total(fault.kind, 0x181) == counted
    assert faults.sync == 7


def test_delayed_frame_follows_its_sync() -> None:
    faults = FrameFaults([apply_plan("delay", 1, times=1)])
    assert pass_frames(faults, build_cycles(0, 2)) == [(0x80, b"\1"), (0x80, b"\2"), (0x181, b"\0\0"), (0x181, b"\1\0")]
    assert faults.is_idle is False


def test_reordered_frame_is_overtaken_by_given_count() -> None:
    frames = [(0x181, bytes([k])) for k in range(7)]
    assert list_numbers(pass_frames(FrameFaults([apply_plan("reorder")]), frames)) == [1, 0, 3, 2, 5, 4]
    assert list_numbers(pass_frames(FrameFaults([apply_plan("reorder", 3, times=1)]), frames)) == [1, 2, 3, 0, 4, 5, 6]


def test_late_frame_is_released_after_delay() -> None:
    faults = FrameFaults([apply_plan("late", 0.25, times=1)])
    assert faults.process_frame((0x181, b"\7"), "received", 100.0) == []
    assert faults.find_next_due_s() == 100.25
    assert faults.release_due("received", 100.2) == faults.release_due("sent", 100.3) == []
    assert faults.release_due("received", 100.25) == [((0x181, b"\7"), None)]
    assert faults.find_next_due_s() == float("inf")


def test_injected_frame_comes_with_every_sync_in_its_direction() -> None:
    flood = apply_plan("inject", 3, can_ids={0x81}, data=b"\x10\x32", from_sync=1, until_sync=3)
    faults = FrameFaults([flood])
    out = pass_frames(faults, build_cycles(0, 5))
    assert [can_id for can_id, _ in out] == [0x80, 0x181, *[0x80, 0x81, 0x81, 0x81, 0x181] * 2, *[0x80, 0x181] * 2]
    faults = FrameFaults([apply_plan("inject", 1000, times=1500, way="sent", data=b"")])
    assert len(pass_frames(faults, build_cycles(0, 5))) == 10
    assert len(faults.release_due("sent", 0.0)) == 1500


def test_corrupted_content_fits_can_frame() -> None:
    frame = (0x181, bytes(range(8)))
    (turned,) = pass_frames(FrameFaults([apply_plan("mutate", 3)]), [frame])
    assert sum((a ^ b).bit_count() for a, b in zip(turned[1], frame[1], strict=True)) == 3
    assert pass_frames(FrameFaults([apply_plan("truncate", 3)]), [frame]) == [(0x181, b"\0\1\2")]
    (longer,) = pass_frames(FrameFaults([apply_plan("extend", 8)]), [(0x181, b"\1\2")])
    assert longer[1][:2] == b"\1\2"
    assert len(longer[1]) == 8


@given(st.integers(0, 99), st.lists(st.sampled_from(["sent", "received"]), max_size=60))
def test_same_seed_affects_same_frames_regardless_of_other_direction(seed: int, ways: list[Way]) -> None:
    plan = [apply_plan("drop", percent=40), apply_plan("mutate", 5, percent=30)]
    both, one = FrameFaults(plan, seed), FrameFaults(plan, seed)
    received = [
        out
        for k, way in enumerate(ways)
        for out in both.process_frame((0x181, bytes([k])), way, 0.0)
        if way == "received"
    ]
    mine = [k for k, way in enumerate(ways) if way == "received"]
    assert received == [out for k in mine for out in one.process_frame((0x181, bytes([k])), "received", 0.0)]


def test_percentage_of_affected_frames_matches_plan() -> None:
    faults = FrameFaults([apply_plan("drop", percent=5)], seed=3)
    left = pass_frames(faults, [(0x181, b"")] * 20_000)
    assert len(left) + faults.total("drop") == 20_000
    assert faults.total("drop") == pytest.approx(1000, abs=150)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"kind": "los"}, "unknown fault 'los'; the faults are drop"),
        ({"kind": "mutate", "value": 65}, "bits that are flipped"),
        ({"kind": "delay", "value": 1.5}, "not a whole number"),
        ({"kind": "drop", "percent": 0}, "percent is 0"),
        ({"kind": "inject", "data": bytes(9), "can_ids": {1}}, "at most 8"),
        ({"kind": "inject"}, "one identifier"),
    ],
)
def test_inconsistent_plan_is_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        FrameFault(**wrong)


def test_bus_down_drops_and_counts_frames() -> None:
    faults = FrameFaults()
    faults.down = True
    assert pass_frames(faults, build_cycles(0, 3)) == []
    assert faults.total("down") == 6


# -- over python-can


@pytest.fixture
def bus_pair() -> Iterator[tuple[FaultBus, can.BusABC]]:
    """A bus without planned faults, and another party on it."""
    channel = uuid.uuid4().hex
    with (
        can.Bus(interface="virtual", channel=channel) as other,
        FaultBus(can.Bus(interface="virtual", channel=channel), seed=1) as bus,
    ):
        yield bus, other


def build_message(can_id: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False} | more)


def receive_messages(bus: can.BusABC, count: int) -> list[can.Message]:
    found = [bus.recv(60.0) for _ in range(count)]
    assert bus.recv(0.0) is None
    return [each for each in found if each is not None]


def test_unaffected_messages_pass_unchanged(bus_pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = bus_pair
    sent = [
        build_message(0x181, b"\1"),
        build_message(0x1ABCDEF, b"", is_extended_id=True),
        build_message(5, is_remote_frame=True),
    ]
    for each in sent:
        other.send(each)
        bus.send(each)
    for party in bus_pair:
        for got, was in zip(receive_messages(party, 3), sent, strict=True):
            assert got.equals(was, timestamp_delta=None, check_channel=False, check_direction=False)


def test_each_direction_has_its_own_faults(bus_pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = bus_pair
    bus.faults.add(FrameFault("drop", way="received", can_ids={0x181}))
    bus.faults.add(FrameFault("truncate", 1, way="sent"))
    for party in bus_pair:
        party.send(build_message(0x181, b"\1\2"))
        party.send(build_message(0x182, b"\3\4"))
    assert [(each.arbitration_id, bytes(each.data)) for each in receive_messages(bus, 1)] == [(0x182, b"\3\4")]
    assert [bytes(each.data) for each in receive_messages(other, 2)] == [b"\1", b"\3"]
    assert dict(bus.faults.counted) == {("drop", 0x181): 1, ("truncate", 0x181): 1, ("truncate", 0x182): 1}


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.ENETDOWN])
def test_planned_error_raises_can_operation_error(number: int, bus_pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = bus_pair
    bus.faults.add(FrameFault("raise", number, times=1))
    with pytest.raises(can.CanOperationError) as caught:
        bus.send(build_message(0x301))
    assert caught.value.error_code == number
    bus.faults.add(FrameFault("raise", number, way="received", times=1))
    other.send(build_message(0x181))
    with pytest.raises(can.CanOperationError):
        bus.recv(60.0)
    bus.send(build_message(0x302))
    assert [each.arbitration_id for each in receive_messages(other, 1)] == [0x302]


def test_late_and_injected_frames_wake_receiver(bus_pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = bus_pair
    bus.faults.add(FrameFault("late", 0.05, way="received", can_ids={0x581}))
    bus.faults.add(FrameFault("inject", can_ids={0x81}, data=b"\x10\x32"))
    bus.send(build_message(0x80, b"\1"))
    other.send(build_message(0x581))
    assert [each.arbitration_id for each in receive_messages(bus, 2)] == [0x81, 0x581]
    bus.faults.add(FrameFault("late", 0.05, way="sent", can_ids={0x601}))
    bus.send(build_message(0x601))
    while bus.faults.find_next_due_s() < float("inf"):
        assert bus.recv(0.02) is None
    assert [each.arbitration_id for each in receive_messages(other, 2)] == [0x80, 0x601]


def test_periodic_messages_go_through_plan(bus_pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = bus_pair
    bus.faults.add(FrameFault("mutate", 8))
    task = bus.send_periodic(build_message(0x701, b"\5"), 0.001)
    got = other.recv(60.0)
    task.stop()
    assert got is not None
    assert bytes(got.data) == b"\xfa"


@pytest.mark.usefixtures("real_time")
def test_canopen_network_repeats_sdo_request_lost_by_fault(bus_pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = bus_pair
    drive = SimulatedDrive("X", build_machine_config(), np.random.default_rng(1))
    drive.power_on()
    ended = threading.Event()

    def serve_drive() -> None:
        while not ended.is_set():
            request = other.recv(0.02)
            for can_id, data in drive.receive_frame(request.arbitration_id, bytes(request.data)) if request else ():
                other.send(build_message(can_id, data))

    thread = threading.Thread(target=serve_drive)
    thread.start()
    network = canopen.Network(bus=bus)
    network.connect()
    node: Any = network.add_node(drive.node_id, load_dictionary(drive))
    try:
        bus.faults.add(FrameFault("drop", way="received", can_ids={0x581}, times=1))
        node.sdo.MAX_RETRIES = 200
        assert node.sdo[0x1000].raw == drive.dictionary.get_number(0x1000)
        assert bus.faults.total("drop") == 1
    finally:
        ended.set()
        thread.join()
        network.disconnect()


@pytest.mark.parametrize("kind", VALUES)
def test_every_fault_kind_counts_its_frames(kind: str) -> None:
    faults = FrameFaults([apply_plan(kind)])
    faults.process_frame((0x80, b"\1"), "received", 0.0)
    with pytest.raises(PlannedBusError) if kind == "raise" else nullcontext():
        assert faults.process_frame((0x181, b"\1\2"), "received", 0.0) != [((0x181, b"\1\2"), None)] or kind == "inject"
    assert faults.total(kind) == 1
    assert not faults.is_idle
