"""Times of other clocks are converted to the host's clock: drift, late readings, clocks that are set."""

from __future__ import annotations

import random
import socket
import struct

import pytest

from fdhil.drivers.can import socketcan_port
from fdhil.drivers.can.host_clock import RemoteClock, WallClock
from fdhil.drivers.can.socketcan_port import SocketCanPort

MS = 1_000_000
S = 1_000_000_000


@pytest.mark.parametrize("drift", [-1e-4, 0.0, 1e-4])
def test_drifting_clock_is_tracked_despite_late_readings(drift: float) -> None:
    clock, chance = RemoteClock(window_s=2.0), random.Random(5)
    worst = 0
    for k in range(20_000):
        sent_ns = k * MS
        late_ns = round(chance.expovariate(1 / (0.3 * MS))) + (30 * MS if k % 1000 < 100 else 0)
        stamp_ns = 77 * S + round(sent_ns * (1 + drift))
        told_ns = stamp_ns - clock.track_ahead_ns(stamp_ns, sent_ns + late_ns)
        worst = max(worst, abs(told_ns - sent_ns)) if k > 2000 else 0
    assert worst < 0.25 * MS  # 0.1 ms a second over two seconds, and what the quickest reading was late


@pytest.mark.fault("A28")
def test_clock_that_was_set_is_tracked_from_there() -> None:
    clock = RemoteClock(window_s=2.0)
    assert clock.track_ahead_ns(50 * S, 10 * S) == 40 * S
    assert clock.track_ahead_ns(20 * S, 11 * S) == 9 * S
    assert clock.track_ahead_ns(90 * S, 12 * S) == 78 * S
    assert clock.track_ahead_ns(90 * S + 500 * MS, 13 * S) == 78 * S  # half a second late
    assert clock.track_ahead_ns(93 * S, 15 * S + 500 * MS) == 77 * S + 500 * MS  # the quick one is long ago


def open_port() -> SocketCanPort:
    """A port without its socket, to test how the kernel's messages are read."""
    port = SocketCanPort.__new__(SocketCanPort)
    port.stamps, port.kernel_drops = "kernel", 0
    port._wall_clock, port._controller = WallClock(), RemoteClock(2.0)
    return port


def read_stamps(kernel_ns: int, controller_ns: int) -> list[tuple[int, int, bytes]]:
    parts = *divmod(kernel_ns, S), 0, 0, *divmod(controller_ns, S)
    return [(socket.SOL_SOCKET, socketcan_port.SO_TIMESTAMPING, struct.pack("@6l", *parts))]


def test_controller_stamps_are_used_when_available(monkeypatch: pytest.MonkeyPatch) -> None:
    """One period apart by the controller's clock, however late the kernel stamped them."""
    monkeypatch.setattr(socketcan_port, "convert_to_monotonic_ns", lambda wall_ns, ahead_ns: wall_ns - ahead_ns)
    port = open_port()
    late = [0, 3 * MS, 2 * MS, 1 * MS, 0, 7 * MS]
    reported = [port._read_stamp(read_stamps(100 * S + k * MS + late[k], 5 * S + k * MS), 40 * S) for k in range(6)]
    assert reported == [60 * S + k * MS for k in range(6)]
    assert port.stamps == "hardware"


def test_kernel_stamps_are_used_without_controller_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socketcan_port, "convert_to_monotonic_ns", lambda wall_ns, ahead_ns: wall_ns - ahead_ns)
    port = open_port()
    assert port._read_stamp(read_stamps(100 * S + 5, 0), 40 * S) == 60 * S + 5
    assert port.stamps == "kernel"


def test_drop_count_continues_past_32_bits() -> None:
    port = open_port()
    for count, drops in [
        (7, 7),
        (5, 7),
        (2**31, 2**31),
        (2**32 - 1, 2**32 - 1),
        (3, 2**32 + 3),
        (2**32 - 1, 2**32 + 3),
    ]:
        port._count_drops(count)
        assert port.kernel_drops == drops
