"""The raw socket on a real SocketCAN interface (vcan0): order, stamps, no loss, and every drop counted."""

from __future__ import annotations

import asyncio
import mmap
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from fdhil.commissioning.transmit import TransmitBus
from fdhil.config import CanBus as BusSettings
from fdhil.drivers.bus_source import BusSource
from fdhil.drivers.can.bus_listener import ListeningBus
from fdhil.drivers.can.filters import build_drive_filters
from fdhil.drivers.can.frame_ring import FrameRing
from fdhil.drivers.can.socketcan_port import SocketCanPort
from fdhil.errors import ConnectError
from fdhil.records import Notice
from tests.drivers.frame_builder import build_machine_config
from tests.socketcan.interface import CAN_FRAME, raw_socket, send, set_up

pytestmark = pytest.mark.socketcan
SETTINGS = BusSettings(interface="socketcan", channel="vcan0")
MANY = 320_000
FRAME_BYTES = 1_024  # of the kernel's memory, and some more
FULL_BUS = 80  # frames of 8 bytes in 10 ms: 1 Mbit/s is full

SENDER = """
import mmap, sys, time
from tests.socketcan.interface import raw_socket, send
frames, per_turn, ahead, file = *map(int, sys.argv[1:4]), sys.argv[4]
with raw_socket() as raw, open(file, "rb") as shared, mmap.mmap(shared.fileno(), 8, prot=mmap.PROT_READ) as heard:
    due = time.monotonic()
    for number in range(frames):
        send(raw, number)
        if number % per_turn == per_turn - 1:
            due = max(due + 0.010, time.monotonic() - 0.010)  # never more than a turn faster than a full bus
            time.sleep(max(0.0, due - time.monotonic()))
            while number - int.from_bytes(heard[:8], "little") > ahead:
                time.sleep(0.001)
"""

READER = """
import sys, time
from fdhil.config import CanBus as BusSettings
from fdhil.drivers.can.bus_listener import ListeningBus
with ListeningBus("can0", BusSettings(interface="socketcan", channel="vcan0")) as bus:
    print("ready", flush=True)
    sys.stdin.readline()
    last, got = -1, 0
    while True:
        frames = bus.drain_frames()
        numbers = frames["data"].astype("int64")
        got += numbers.size
        counted = bus.read_counters()
        print(counted["frames"], counted["ring_overflow"], counted["kernel_drops"], got, flush=True)
        time.sleep(0.1)
"""


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with raw_socket() as raw:
        yield raw


def surely_held(bus: ListeningBus) -> int:
    assert isinstance(bus._port, SocketCanPort)
    granted = bus._port._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    return max(FULL_BUS, min(5_000, granted // FRAME_BYTES - FULL_BUS))


def wait_for(condition: Callable[[], bool], limit_s: float = 100.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_frames_arrive_in_order_with_kernel_stamps(sender: socket.socket) -> None:
    with ListeningBus("can0", SETTINGS) as bus:
        time.sleep(0.05)
        before = time.monotonic_ns()
        for number in range(2000):
            send(sender, number)
            if number % 100 == 99:  # a receive buffer that may not be enlarged holds 278
                wait_for(lambda number=number: bus.read_counters()["frames"] == number + 1)  # type: ignore[misc]
        after = time.monotonic_ns()
        frames = bus.drain_frames()
        counters = bus.read_counters()
        assert bus.stamps == "kernel"
    assert frames["data"].tolist() == list(range(2000))
    assert counters["lost"] == 0
    stamps = frames["t_ns"].tolist()
    assert min(np.diff(stamps)) > -100_000  # the wall clock is followed slowly, never by a jump
    assert before - 2_000_000 < stamps[0] <= stamps[-1] < after + 2_000_000


def test_full_bus_loses_no_frame(tmp_path: Path) -> None:
    file = tmp_path / "heard"
    file.write_bytes(bytes(8))
    numbers: list[int] = []
    with ListeningBus("can0", SETTINGS) as bus, file.open("r+b") as shared, mmap.mmap(shared.fileno(), 8) as received:
        arguments = [sys.executable, "-c", SENDER, str(MANY), str(FULL_BUS), str(surely_held(bus)), str(file)]
        with subprocess.Popen(arguments) as process:
            while process.poll() is None:
                numbers += bus.drain_frames()["data"].tolist()
                received[:8] = len(numbers).to_bytes(8, "little")
                time.sleep(0.05)
        wait_for(lambda: bus.read_counters()["frames"] + bus.read_counters()["lost"] >= MANY)
        numbers += bus.drain_frames()["data"].tolist()
        assert bus.read_counters() == {"frames": MANY, "ring_overflow": 0, "kernel_drops": 0, "lost": 0}
    assert numbers == list(range(MANY))


@pytest.mark.fault("A6")
def test_frames_dropped_by_the_kernel_are_counted(sender: socket.socket) -> None:
    port = SocketCanPort("can0", SETTINGS)
    port._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    ring, drops = FrameRing(1 << 14), []
    for first in range(0, 3000, 600):
        for number in range(first, first + 600):
            send(sender, number)
        port.receive_frames(ring, 0.05)
        assert ring.received_count + port.kernel_drops == first + 600
        drops.append(port.kernel_drops)
    assert drops == sorted(set(drops))
    assert drops[0] > 0
    port.close()


def test_stopped_reader_counts_missed_frames(sender: socket.socket) -> None:
    arguments = [sys.executable, "-c", READER]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdin is not None
        assert reader.stdout.readline() == "ready\n"
        reader.stdin.write("\n")
        reader.stdin.flush()
        os.kill(reader.pid, signal.SIGSTOP)
        for number in range(60_000):
            send(sender, number)
        os.kill(reader.pid, signal.SIGCONT)
        received = overflow = drops = drained = 0
        while received + drops < 60_000 or drained + overflow < received:
            received, overflow, drops, drained = map(int, reader.stdout.readline().split())
        reader.kill()
    assert received + drops == 60_000
    assert drained + overflow == received
    assert drops > 30_000


def test_kernel_filter_passes_only_the_drives_frames(sender: socket.socket) -> None:
    with ListeningBus("can0", SETTINGS, filters=build_drive_filters([1, 4], [0x33])) as bus:
        wanted = [0x000, 0x080, 0x081, 0x181, 0x201, 0x304, 0x581, 0x601, 0x704, 0x033]
        for can_id in [0x182, 0x7FF, 0x032, 0x80000001, 0x80000033, *wanted]:
            send(sender, 1, can_id)
        wait_for(lambda: bus.read_counters()["frames"] >= len(wanted))
        assert bus.drain_frames()["id"].tolist() == wanted


def test_missing_or_down_interface_is_refused() -> None:
    set_up("vcan0", False)
    try:
        with pytest.raises(ConnectError, match=r"is down.*ip link set vcan0 up type can bitrate 1000000"):
            ListeningBus("can0", SETTINGS)
    finally:
        set_up("vcan0", True)
    with pytest.raises(ConnectError, match=r"No such device.*plug the adapter in"):
        ListeningBus("can0", BusSettings(interface="socketcan", channel="nocan9"))


@pytest.mark.fault("A4")
async def test_reception_resumes_after_the_interface_returns(tmp_path: Path) -> None:
    source = BusSource("can0", build_machine_config(tmp_path, bus={"interface": "socketcan", "channel": "vcan0"}))
    source.open()
    result: list[str] = []

    async def until(condition: Callable[[], bool]) -> None:
        for _ in range(2000):
            if condition():
                return
            await asyncio.sleep(0.02)
        raise AssertionError(result)

    running = asyncio.create_task(source.run(lambda r: result.append(r.text) if isinstance(r, Notice) else None))
    try:
        for turn in range(3):
            with raw_socket() as sender:
                for number in range(50):
                    send(sender, number)
            await until(lambda: source.read_counters()["frames"] == 50 * (turn + 1))  # noqa: B023 - it is asked now
            set_up("vcan0", False)
            await until(lambda: sum("is down or gone (Network is down)" in text for text in result) == turn + 1)  # noqa: B023
            await asyncio.sleep(0.2)
            set_up("vcan0", True)
            await until(lambda: result.count("Bus can0 is back.") == turn + 1)  # noqa: B023
            assert sum("is retried" in text for text in result) == turn + 1
    finally:
        set_up("vcan0", True)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        source.close()


def test_sent_frame_arrives(sender: socket.socket) -> None:
    with TransmitBus("can0", SETTINGS) as bus:
        bus.send(0x601, b"\x40\x18\x10")
        can_id, length, data = CAN_FRAME.unpack(sender.recv(16))
    assert (can_id, data[:length]) == (0x601, b"\x40\x18\x10")
