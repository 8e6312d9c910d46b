"""Acquisition of a full CAN bus: a million frames through receive and decode, then a paced bus beside a fit.

    python benchmarks/acquisition.py [--frames 1000000] [--seconds 20]

A second process plays the hub (socketcand protocol on loopback): SYNC with counter and the default mapping of three
axes, 7.8 frames per millisecond. Prints a table.
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import socket
import struct
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from fdhil.config import CanBus, MachineConfig, parse_config
from fdhil.drivers.bus_source import DRAIN_S
from fdhil.drivers.can.bus_listener import ListeningBus as Bus
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.records import AxisSamples

AXES = ("X", "Y")
CYCLES = 240
STAMP = b"1700000000.000000"


def make_machine(clock: str) -> MachineConfig:
    """The bench with two axes; ``clock`` "sync" for a bus that runs ahead of the time."""
    axis = {
        "screw_pitch_mm": 20.0, "rapid_speed_mm_s": 500.0, "max_acceleration_mm_s2": 4000.0,
        "nominal": {"R": 0.5, "L": 0.005, "K": 0.8, "Jt": 0.075, "ft": 0.05, "Cd": 5.0},
        "regulators": {
            "position_gain_per_s": 50.0, "speed_kp": 23.562, "speed_ki": 1184.35, "current_limit_a": 200.0,
            "current_kp": 12.566, "current_ki": 1256.64, "voltage_limit_v": 300.0,
        },
    }  # fmt: skip
    return parse_config({"machine": {"name": "bench"}, "axis": dict.fromkeys(AXES, axis), "guard": {"clock": clock}})


def make_cycle_frames(k: int) -> list[tuple[int, bytes]]:
    """What the bus carries in SYNC cycle k: 7 frames for three axes' worth of traffic, some more every tenth cycle."""
    frames = [(0x80, bytes([k % 240 + 1]))]
    for node in range(1, len(AXES) + 1):
        frames += [
            (0x180 + node, struct.pack("<ii", 1000 * k, 5 * k)),
            (0x280 + node, struct.pack("<Hhh", 0x1237, k % 100, k % 90)),
            (0x200 + node, struct.pack("<Hi", 0x0F, 1000 * k)),
        ]
        if k % 10 == 0:
            frames += [
                (0x380 + node, struct.pack("<ii", 1000 * k - 2000, 0)),
                (0x480 + node, struct.pack("<Ibh", 0, 8, 0)),
            ]
    if k % 5:
        frames.append((0x300 + 1, struct.pack("<i", 0)))
    return frames


def serve_frames(pipe: Connection) -> None:
    """The other process: serve one client, send as ordered by (cycles, paced)."""
    texts = []
    for k in range(CYCLES):
        text = "".join(
            f"< frame {i:03X} {STAMP.decode()} {d.hex().upper()}".ljust(62) + " >" for i, d in make_cycle_frames(k)
        )
        texts.append(text.encode())
    with socket.create_server(("127.0.0.1", 0)) as server:
        pipe.send(server.getsockname()[1])
        client, _ = server.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for greeting in (b"< hi >", b"< ok >", b"< ok >"):
            if greeting != b"< hi >":
                client.recv(256)
            client.sendall(greeting)
        while order := pipe.recv():
            cycles, paced = order
            due = time.monotonic()
            for k in range(cycles):
                if paced:
                    due += 0.001
                    time.sleep(max(0.0, due - time.monotonic()))
                client.sendall(texts[k % CYCLES].replace(STAMP, b"%.6f" % time.time()))
            pipe.send("done")


def fit_load(stopping: threading.Event) -> None:
    """What a fit does meanwhile: linear algebra that lets go of the GIL, and some Python."""
    rng = np.random.default_rng(1)
    matrix, right = rng.standard_normal((4000, 6)), rng.standard_normal(4000)
    while not stopping.is_set():
        np.linalg.lstsq(matrix, right, rcond=None)


def count_lost(bus: Bus, decoder: BusDecoder) -> int:
    """All that was lost so far."""
    counted = decoder.read_counters()
    return bus.read_counters()["lost"] + counted["pdo_lost"] + counted["sync_missed"]


def receive_cycles(bus: Bus, decoder: BusDecoder, pipe: Connection, cycles: int, paced: bool) -> dict[str, float]:
    """Receive and decode what the hub sends for ``cycles``; returns figures."""
    frames_before, lost_before = bus.read_counters()["frames"], count_lost(bus, decoder)
    expected = sum(len(make_cycle_frames(k % CYCLES)) for k in range(cycles))
    rows, wall, cpu = 0, time.perf_counter(), time.process_time()
    pipe.send((cycles, paced))
    while bus.read_counters()["frames"] - frames_before < expected:
        time.sleep(DRAIN_S if paced else 0.005)
        records = decoder.decode_frames(bus.drain_frames(), time.monotonic_ns())
        rows += sum(r.tick.size for r in records if isinstance(r, AxisSamples))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    pipe.recv()
    return {
        "frames": expected,
        "frames_per_s": expected / wall,
        "cpu_percent": 100 * cpu / wall,
        "us_per_frame": 1e6 * cpu / expected,
        "lost": count_lost(bus, decoder) - lost_before,
        "rows": rows,
    }


def main() -> None:
    """Run and print."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--frames", type=int, default=1_000_000)
    arguments.add_argument("--seconds", type=float, default=20.0)
    options = arguments.parse_args()
    ours, theirs = mp.Pipe()
    process = mp.get_context("fork").Process(target=serve_frames, args=(theirs,), daemon=True)
    process.start()
    results: dict[str, Any] = {}
    with Bus("can0", CanBus(port=ours.recv()), ring_frames=1 << 18) as bus:
        ahead, decoder = (BusDecoder("can0", make_machine(clock)) for clock in ("sync", "monotonic"))
        per_cycle = sum(len(make_cycle_frames(k)) for k in range(CYCLES)) / CYCLES
        cycles = CYCLES * round(options.frames / per_cycle / CYCLES)
        paced = CYCLES * max(1, round(options.seconds * 1000 / CYCLES))
        results["flat out"] = receive_cycles(bus, ahead, ours, cycles, paced=False)
        results["paced 1 kHz"] = receive_cycles(bus, decoder, ours, paced, paced=True)
        stopping = threading.Event()
        load = threading.Thread(target=fit_load, args=(stopping,))
        load.start()
        results["paced, beside a fit"] = receive_cycles(bus, decoder, ours, paced, paced=True)
        stopping.set()
        load.join()
        ours.send(None)
    process.join()
    print(f"{'':22}{'frames':>10}{'frames/s':>12}{'CPU %':>8}{'us/frame':>10}{'lost':>6}")
    for name, r in results.items():
        cpu = "-" if "fit" in name else f"{r['cpu_percent']:.1f}"
        print(f"{name:22}{r['frames']:>10}{r['frames_per_s']:>12.0f}{cpu:>8}{r['us_per_frame']:>10.2f}{r['lost']:>6}")


if __name__ == "__main__":
    main()
