"""What a CAN adapter costs without SocketCAN: processor time per frame, how late the time stamps are, what is lost.

    python -m benchmarks.adapters [--seconds 6]

A second process plays a serial adapter (slcan on a pty, which python-can reads); its frames carry the host's monotonic
time. Where the kernel has vcan0, the same through the kernel stands beside it. Prints a table.
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import os
import socket
import struct
import time
import tty
from collections.abc import Callable

import numpy as np

from fdhil.config import CanBus
from fdhil.drivers.can.bus_listener import ListeningBus as Bus

RATES_HZ = (1000, 2500, 8000)
DRAIN_S = 0.05
COB_ID = 0x181
Write = Callable[[bytes], object]


def send(write: Write, rate_hz: int, frames: int) -> None:
    """The other process: some frames each millisecond, with the time in them."""
    per_turn, begun = rate_hz // 1000, time.monotonic() + 0.5
    for turn in range(frames // per_turn):
        time.sleep(max(0.0, begun + turn * per_turn / rate_hz - time.monotonic()))
        for _ in range(per_turn):
            write(struct.pack("<q", time.monotonic_ns()))


def listen(bus: Bus, write: Write, rate_hz: int, frames: int) -> str:
    """Hear what is sent; return a line of the table."""
    sender = mp.get_context("fork").Process(target=send, args=(write, rate_hz, frames), daemon=True)
    late_ms, received, cpu_s, quiet_s = [], 0, time.process_time(), time.monotonic() + 5.0
    sender.start()
    while received < frames and time.monotonic() < quiet_s:
        time.sleep(DRAIN_S)
        block = bus.drain_frames()
        if block.size:
            late_ms.append((block["t_ns"] - block["data"].astype(np.int64)) * 1e-6)
            received, quiet_s = received + block.size, time.monotonic() + 2.0
    cpu_s = time.process_time() - cpu_s
    sender.join()
    median, worst = np.percentile(np.concatenate(late_ms), [50, 99])
    return f"{rate_hz:>10}{1e6 * cpu_s / received:>10.1f}{median:>12.2f}{worst:>12.2f}{frames - received:>6}"


def slcan(rate_hz: int, frames: int) -> str:
    """Through python-can."""
    end, line = os.openpty()
    tty.setraw(line)
    document = {"interface": "slcan", "channel": os.ttyname(line), "options": {"sleep_after_open": 0.0}}
    with Bus("can0", CanBus.model_validate(document)) as bus:
        return listen(bus, lambda data: os.write(end, f"t{COB_ID:03X}8{data.hex()}\r".encode()), rate_hz, frames)


def socketcan(rate_hz: int, frames: int) -> str:
    """Through the kernel; OSError where it has no vcan0."""
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind(("vcan0",))
        with Bus("can0", CanBus(interface="socketcan", channel="vcan0")) as bus:
            return listen(bus, lambda data: raw.send(struct.pack("=IB3x8s", COB_ID, 8, data)), rate_hz, frames)


def main() -> None:
    """Run and print."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=6.0)
    seconds = arguments.parse_args().seconds
    print(f"{'':22}{'frames/s':>10}{'us/frame':>10}{'late p50 ms':>12}{'p99 ms':>12}{'lost':>6}")
    for rate_hz in RATES_HZ:
        frames = rate_hz // 1000 * round(1000 * seconds)
        print(f"{'slcan by python-can':22}{slcan(rate_hz, frames)}")
        try:
            print(f"{'SocketCAN':22}{socketcan(rate_hz, frames)}")
        except OSError:
            print(f"{'SocketCAN':22}{rate_hz:>10}  this kernel has no vcan0")


if __name__ == "__main__":
    main()
