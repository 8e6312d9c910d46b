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

from fdhil.sim.drive.servo import Drive
from fdhil.sim.frame import Frame
from fdhil.sim.frame_faults import VALUES, BusRefuses, FrameFault, FrameFaults, Way
from fdhil.sim.wire.fault_bus import FaultBus
from tests.sim.canopen_peer import dictionary
from tests.sim.rig import machine


def cycles(first: int, last: int) -> list[Frame]:
    """Return SYNC k followed by a frame with k."""
    return [frame for k in range(first, last) for frame in ((0x80, bytes([k % 240 + 1])), (0x181, bytes([k, 0])))]


def passed(faults: FrameFaults, frames: list[Frame], way: Way = "received") -> list[Frame]:
    return [frame for each in frames for frame, _ in faults.take(each, way, 0.0)]


def told(frames: list[Frame]) -> list[int]:
    return [data[0] for can_id, data in frames if can_id == 0x181]


def meet(kind: str, value: float = 1, **more: Any) -> FrameFault:
    return FrameFault(kind, value, **{"can_ids": {0x181}} | more)


@pytest.mark.parametrize(
    ("fault", "left", "counted"),
    [
        (meet("drop", from_sync=2, until_sync=5), [0, 1, 5, 6, 7], 3),
        (meet("drop", times=2), [2, 3, 4, 5, 6, 7], 2),
        (meet("drop", way="sent"), [*range(8)], 0),
        (meet("drop", can_ids={0x182}), [*range(8)], 0),
        (meet("duplicate", 2, from_sync=6), [*range(6), 6, 6, 6, 7, 7, 7], 2),
        (meet("delay", 2, from_sync=3, until_sync=4), [0, 1, 2, 4, 3, 5, 6, 7], 1),
        (meet("truncate", 1, from_sync=7), [*range(8)], 1),
    ],
)
def test_a_fault_meets_the_frames_that_it_names(fault: FrameFault, left: list[int], counted: int) -> None:
    faults = FrameFaults([fault])
    assert told(passed(faults, cycles(0, 8))) == left
    assert faults.total(fault.kind) == faults.total(fault.kind, 0x181) == counted
    assert faults.sync == 7


def test_a_delayed_frame_comes_behind_the_sync_that_it_waits_for() -> None:
    faults = FrameFaults([meet("delay", 1, times=1)])
    assert passed(faults, cycles(0, 2)) == [(0x80, b"\1"), (0x80, b"\2"), (0x181, b"\0\0"), (0x181, b"\1\0")]
    assert faults.idle is False


def test_a_reordered_frame_is_overtaken_by_so_many() -> None:
    frames = [(0x181, bytes([k])) for k in range(7)]
    assert told(passed(FrameFaults([meet("reorder")]), frames)) == [1, 0, 3, 2, 5, 4]
    assert told(passed(FrameFaults([meet("reorder", 3, times=1)]), frames)) == [1, 2, 3, 0, 4, 5, 6]


def test_a_late_frame_waits_for_its_time() -> None:
    faults = FrameFaults([meet("late", 0.25, times=1)])
    assert faults.take((0x181, b"\7"), "received", 100.0) == []
    assert faults.due_s() == 100.25
    assert faults.due("received", 100.2) == faults.due("sent", 100.3) == []
    assert faults.due("received", 100.25) == [((0x181, b"\7"), None)]
    assert faults.due_s() == float("inf")


def test_what_is_injected_comes_with_every_sync_of_its_window_and_on_its_way() -> None:
    flood = meet("inject", 3, can_ids={0x81}, data=b"\x10\x32", from_sync=1, until_sync=3)
    faults = FrameFaults([flood])
    out = passed(faults, cycles(0, 5))
    assert [can_id for can_id, _ in out] == [0x80, 0x181, *[0x80, 0x81, 0x81, 0x81, 0x181] * 2, *[0x80, 0x181] * 2]
    faults = FrameFaults([meet("inject", 1000, times=1500, way="sent", data=b"")])
    assert len(passed(faults, cycles(0, 5))) == 10
    assert len(faults.due("sent", 0.0)) == 1500


def test_content_is_spoilt_within_what_a_frame_can_hold() -> None:
    frame = (0x181, bytes(range(8)))
    (turned,) = passed(FrameFaults([meet("mutate", 3)]), [frame])
    assert sum((a ^ b).bit_count() for a, b in zip(turned[1], frame[1], strict=True)) == 3
    assert passed(FrameFaults([meet("truncate", 3)]), [frame]) == [(0x181, b"\0\1\2")]
    (longer,) = passed(FrameFaults([meet("extend", 8)]), [(0x181, b"\1\2")])
    assert longer[1][:2] == b"\1\2"
    assert len(longer[1]) == 8


@given(st.integers(0, 99), st.lists(st.sampled_from(["sent", "received"]), max_size=60))
def test_the_same_seed_spoils_the_same_frames_whatever_goes_the_other_way(seed: int, ways: list[Way]) -> None:
    plan = [meet("drop", percent=40), meet("mutate", 5, percent=30)]
    both, one = FrameFaults(plan, seed), FrameFaults(plan, seed)
    heard = [out for k, way in enumerate(ways) for out in both.take((0x181, bytes([k])), way, 0.0) if way == "received"]
    mine = [k for k, way in enumerate(ways) if way == "received"]
    assert heard == [out for k in mine for out in one.take((0x181, bytes([k])), "received", 0.0)]


def test_a_share_of_the_frames_is_what_is_asked_for() -> None:
    faults = FrameFaults([meet("drop", percent=5)], seed=3)
    left = passed(faults, [(0x181, b"")] * 20_000)
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
def test_a_plan_that_makes_no_sense_is_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        FrameFault(**wrong)


def test_a_bus_that_is_down_passes_nothing_and_counts_it() -> None:
    faults = FrameFaults()
    faults.down = True
    assert passed(faults, cycles(0, 3)) == []
    assert faults.total("down") == 6


# -- over python-can


@pytest.fixture
def pair() -> Iterator[tuple[FaultBus, can.BusABC]]:
    """A bus without planned faults, and another party on it."""
    channel = uuid.uuid4().hex
    with (
        can.Bus(interface="virtual", channel=channel) as other,
        FaultBus(can.Bus(interface="virtual", channel=channel), seed=1) as bus,
    ):
        yield bus, other


def message(can_id: int, data: bytes = b"", **more: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False} | more)


def heard(bus: can.BusABC, count: int) -> list[can.Message]:
    found = [bus.recv(60.0) for _ in range(count)]
    assert bus.recv(0.0) is None
    return [each for each in found if each is not None]


def test_what_is_not_spoilt_passes_as_it_is(pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = pair
    sent = [message(0x181, b"\1"), message(0x1ABCDEF, b"", is_extended_id=True), message(5, is_remote_frame=True)]
    for each in sent:
        other.send(each)
        bus.send(each)
    for party in pair:
        for got, was in zip(heard(party, 3), sent, strict=True):
            assert got.equals(was, timestamp_delta=None, check_channel=False, check_direction=False)


def test_both_ways_are_spoilt_each_by_its_faults(pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = pair
    bus.faults.add(FrameFault("drop", way="received", can_ids={0x181}))
    bus.faults.add(FrameFault("truncate", 1, way="sent"))
    for party in pair:
        party.send(message(0x181, b"\1\2"))
        party.send(message(0x182, b"\3\4"))
    assert [(each.arbitration_id, bytes(each.data)) for each in heard(bus, 1)] == [(0x182, b"\3\4")]
    assert [bytes(each.data) for each in heard(other, 2)] == [b"\1", b"\3"]
    assert dict(bus.faults.counted) == {("drop", 0x181): 1, ("truncate", 0x181): 1, ("truncate", 0x182): 1}


@pytest.mark.parametrize("number", [errno.ENOBUFS, errno.ENETDOWN])
def test_a_planned_error_is_the_librarys_with_its_number(number: int, pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = pair
    bus.faults.add(FrameFault("raise", number, times=1))
    with pytest.raises(can.CanOperationError) as caught:
        bus.send(message(0x301))
    assert caught.value.error_code == number
    bus.faults.add(FrameFault("raise", number, way="received", times=1))
    other.send(message(0x181))
    with pytest.raises(can.CanOperationError):
        bus.recv(60.0)
    bus.send(message(0x302))
    assert [each.arbitration_id for each in heard(other, 1)] == [0x302]


def test_what_is_late_or_made_up_wakes_a_receiver_that_waits(pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = pair
    bus.faults.add(FrameFault("late", 0.05, way="received", can_ids={0x581}))
    bus.faults.add(FrameFault("inject", can_ids={0x81}, data=b"\x10\x32"))
    bus.send(message(0x80, b"\1"))
    other.send(message(0x581))
    assert [each.arbitration_id for each in heard(bus, 2)] == [0x81, 0x581]
    bus.faults.add(FrameFault("late", 0.05, way="sent", can_ids={0x601}))
    bus.send(message(0x601))
    while bus.faults.due_s() < float("inf"):
        assert bus.recv(0.02) is None
    assert [each.arbitration_id for each in heard(other, 2)] == [0x80, 0x601]


def test_what_is_sent_periodically_goes_through_the_plan(pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = pair
    bus.faults.add(FrameFault("mutate", 8))
    task = bus.send_periodic(message(0x701, b"\5"), 0.001)
    got = other.recv(60.0)
    task.stop()
    assert got is not None
    assert bytes(got.data) == b"\xfa"


@pytest.mark.usefixtures("real_time")
def test_a_canopen_network_gets_the_faults_of_its_bus(pair: tuple[FaultBus, can.BusABC]) -> None:
    bus, other = pair
    drive = Drive("X", machine(), np.random.default_rng(1))
    drive.power_on()
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            request = other.recv(0.02)
            for can_id, data in drive.receive(request.arbitration_id, bytes(request.data)) if request else ():
                other.send(message(can_id, data))

    thread = threading.Thread(target=serve)
    thread.start()
    network = canopen.Network(bus=bus)
    network.connect()
    node: Any = network.add_node(drive.node_id, dictionary(drive))
    try:
        bus.faults.add(FrameFault("drop", way="received", can_ids={0x581}, times=1))
        node.sdo.MAX_RETRIES = 200
        assert node.sdo[0x1000].raw == drive.dictionary.number(0x1000)
        assert bus.faults.total("drop") == 1
    finally:
        ended.set()
        thread.join()
        network.disconnect()


@pytest.mark.parametrize("kind", VALUES)
def test_every_kind_counts_what_it_did(kind: str) -> None:
    faults = FrameFaults([meet(kind)])
    faults.take((0x80, b"\1"), "received", 0.0)
    with pytest.raises(BusRefuses) if kind == "raise" else nullcontext():
        assert faults.take((0x181, b"\1\2"), "received", 0.0) != [((0x181, b"\1\2"), None)] or kind == "inject"
    assert faults.total(kind) == 1
    assert not faults.idle
