"""The frame monitor tracks order, age, length and origin of frames, and the regularity of SYNC."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.interlocks import INTERLOCK_CATALOGUE
from tests.guard.simulated_bus import settings


def listener(**changes: object) -> FrameMonitor:
    return FrameMonitor(settings(("X",), **changes))  # type: ignore[arg-type] # fields of Settings


def target(value: int) -> bytes:
    return struct.pack("<Hi", 0x0F, value)


def test_latched_target_is_the_last_before_the_sync() -> None:
    monitor = listener()
    monitor.take_frame(0x201, target(5), 0.0)
    monitor.take_frame(0x201, target(6), 0.0)
    axes, _ = monitor.receive_at_sync(b"\x01", 0.0, 0.0)
    assert axes[0].target == 6
    axes, _ = monitor.receive_at_sync(b"\x02", 0.001, 0.001)
    assert axes[0].target is None


def test_ages_count_in_periods_of_each_pdo() -> None:
    monitor = listener()
    ages = []
    for k in range(1, 40):
        axes, _ = monitor.receive_at_sync(bytes([k]), k * 1e-3, k * 1e-3)
        ages.append(axes[0].feedback_age)
        if k < 20:
            monitor.take_frame(0x181, bytes(8), 0.0)
            monitor.take_frame(0x281, bytes(6), 0.0)
        if k % 10 == 0 and k < 35:
            monitor.take_frame(0x481, bytes(7), 0.0)
    assert ages[9] > 1e6
    assert set(ages[10:20]) == {1}
    assert ages[20:24] == [2, 3, 4, 5]


def test_read_back_is_reported_once() -> None:
    monitor = listener()
    monitor.take_frame(0x381, struct.pack("<ii", 0, -77), 0.0)
    assert monitor.receive_at_sync(b"\x01", 0.0, 0.0)[0][0].read_back == -77
    assert monitor.receive_at_sync(b"\x02", 0.0, 0.0)[0][0].read_back is None


def test_early_frame_invalidates_the_read_back_next_to_it() -> None:
    """TPDO3 is due every tenth SYNC: one within half of that, or two in one, prove nothing."""
    monitor = listener()
    shown, ages = [], []
    for k in range(1, 60):
        axes, _ = monitor.receive_at_sync(bytes([k]), k * 1e-3, k * 1e-3)
        shown.append(axes[0].read_back)
        ages.append(axes[0].read_back_age)
        if k % 10 == 0:
            monitor.take_frame(0x381, struct.pack("<ii", 7, 7), 0.0)
        if k == 20:
            monitor.take_frame(0x381, struct.pack("<ii", 7, 7), 0.0)  # the very same frame again
        if k in (30, 44):
            monitor.take_frame(0x381, struct.pack("<ii", 7, 500), 0.0)
    assert [k + 1 for k, value in enumerate(shown) if value is not None] == [11, 21, 41, 51]
    assert 500 not in shown
    assert ages[20] == 1
    assert ages[30] == 2


def test_receive_filter_has_all_needed_ids() -> None:
    ids = listener().list_received_ids()
    assert {0x000, 0x080, 0x081, 0x181, 0x201, 0x301, 0x381, 0x481, 0x601, 0x701, 0x764} <= set(ids)
    assert ids == tuple(sorted(ids))


def test_sync_counter_restarts_after_a_silence() -> None:
    monitor = listener()
    monitor.receive_at_sync(b"\x05", 0.0, 0.0)
    monitor.forget_sync()
    _, bus = monitor.receive_at_sync(b"\x99", 9.0, 9.0)
    assert not bus.sync_regular
    assert monitor.take_alarms() == ()


def test_short_pdo_is_dropped_and_long_one_is_counted() -> None:
    monitor = listener()
    monitor.take_frame(0x281, struct.pack("<Hi", 0x1237, 0), 0.0)
    for _ in range(3):
        monitor.take_frame(0x281, b"\0", 0.0)
    axes, _ = monitor.receive_at_sync(b"\x01", 0.0, 0.0)
    assert (axes[0].statusword, axes[0].short_frames, axes[0].long_frames) == (0x1237, 3, 0)
    monitor.take_frame(0x281, struct.pack("<Hi", 0x0237, 0) + b"\0", 0.0)
    axes, _ = monitor.receive_at_sync(b"\x02", 0.0, 0.0)
    assert (axes[0].statusword, axes[0].short_frames, axes[0].long_frames) == (0x0237, 0, 1)


@pytest.mark.parametrize(
    ("cob_id", "data", "code"),
    [
        (0x301, b"\0\0\0\0", "OffsetHijack"),
        (0x764, b"\x05", "BusLocked"),
        (0x701, b"\x00", "NodeRebooted"),
        (0x000, b"\x02\x01", "NmtStateWrong"),
        (0x000, b"\x81\x00", "NmtStateWrong"),
        (0x081, b"\x10\x23\x01\0\0\0\0\0", "DriveEmergency"),
        (0x081, b"", "DriveEmergency"),
        (0x000, b"\x01\x01", None),
        (0x000, b"\x02\x05", None),
        (0x000, b"", None),
        (0x701, b"\x05", None),
        (0x701, b"", None),
        (0x705, b"\x00", None),
        (0x081, b"\0\0\0\0\0\0\0\0", None),
        (0x085, b"\x10\x23\0\0\0\0\0\0", None),
    ],
)
def test_each_event_frame_raises_its_alarm(cob_id: int, data: bytes, code: str | None) -> None:
    monitor = listener()
    monitor.take_frame(cob_id, data, 0.0)
    assert [alarm.code for alarm in monitor.take_alarms()] == ([code] if code else [])
    assert monitor.take_alarms() == ()


@pytest.mark.fault("A21")
def test_flood_of_events_is_one_alarm() -> None:
    monitor = listener()
    for _ in range(10_000):
        monitor.take_frame(0x081, b"\x10\x23", 0.0)
    assert monitor.emergencies == 10_000
    assert len(monitor.take_alarms()) == 1


@pytest.mark.parametrize(
    ("counters", "codes"),
    [
        ([1, 2, 3], []),
        ([239, 240, 1, 2], []),
        ([5, 6, 1, 2], []),
        ([1, 2, 4], ["RxOverflow"]),
        ([1, 2, 2], ["SyncCollision"]),
        ([10, 11, 100], ["SyncCollision"]),
        ([10, 11, 9], ["SyncCollision"]),
    ],
)
def test_sync_counter_jump_raises_an_alarm(counters: list[int], codes: list[str]) -> None:
    monitor = listener()
    for counter in counters:
        monitor.receive_at_sync(bytes([counter]), 0.0, 0.0)
    assert [alarm.code for alarm in monitor.take_alarms()] == codes


def test_sync_without_counter_is_not_checked() -> None:
    monitor = listener()
    for data in (b"", b"\x05", b"", b"\x09", b"\x00\x01"):
        monitor.receive_at_sync(data, 0.0, 0.0)
    assert monitor.take_alarms() == ()


def regular(intervals: list[tuple[float, float]], period_s: float = 0.001) -> list[bool]:
    """Return whether each SYNC was regular, for (stamp, arrival) intervals in monotonic time."""
    monitor = listener(clock="monotonic", sync_period_s=period_s)
    stamp = arrival = 100.0
    result = [monitor.receive_at_sync(b"", stamp, arrival)[1].sync_regular]
    for by_stamp, by_arrival in intervals:
        stamp, arrival = stamp + by_stamp, arrival + by_arrival
        result.append(monitor.receive_at_sync(b"", stamp, arrival)[1].sync_regular)
    return result


def test_regular_sync_is_accepted() -> None:
    assert regular([(0.001, 0.001)] * 40) == [False] + [True] * 40


@pytest.mark.fault("A28")
def test_late_reader_and_set_clock_do_not_make_sync_irregular() -> None:
    assert all(regular([(0.001, 0.001)] * 20 + [(0.001, 0.02)] + [(0.001, 1e-5)] * 18)[1:])
    assert all(regular([(0.001, 0.001)] * 20 + [(-3600.0, 0.001)] + [(0.001, 0.001)] * 18)[1:])


def test_jitter_and_a_wrong_period_are_detected() -> None:
    result = regular([(0.001, 0.001)] * 10 + [(0.0031, 0.0031)] + [(0.001, 0.001)] * 3)
    assert result[11] is False
    assert result[12] is True
    assert not any(regular([(0.00103, 0.00103)] * 40))


def test_two_senders_of_one_id_are_detected_after_three_cycles() -> None:
    monitor = listener()
    for k in range(1, 5):
        monitor.take_frame(0x281, struct.pack("<Hi", 0x1237, 0), 0.0)
        monitor.take_frame(0x281, struct.pack("<Hi", 0x1237, 0), 0.0)  # a duplicate says nothing new
        monitor.receive_at_sync(bytes([k]), 0.0, 0.0)
    assert monitor.take_alarms() == ()
    for k in range(5, 8):
        monitor.take_frame(0x281, struct.pack("<Hi", 0x1237, 0), 0.0)
        monitor.take_frame(0x281, struct.pack("<Hi", 0x1237, 1), 0.0)
        monitor.receive_at_sync(bytes([k]), 0.0, 0.0)
    assert [alarm.code for alarm in monitor.take_alarms()] == ["ForeignProducer"]


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8))))
def test_any_traffic_is_accepted_without_error(frames: list[tuple[int, bytes]]) -> None:
    monitor = listener()
    for cob_id, data in frames:
        monitor.take_frame(cob_id, data, 0.0)
        monitor.receive_at_sync(data[:1], 0.0, 0.0)
    axes, _ = monitor.read_between_syncs(0.0, True)
    assert len(axes) == len(monitor.settings.axes)
    assert {alarm.code for alarm in monitor.take_alarms()} <= INTERLOCK_CATALOGUE.keys()
