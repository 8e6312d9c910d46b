"""Latency of the guard: from SYNC on the wire to the offset frames of both axes, and the time of one step of its core.

    python benchmarks/guard_latency.py [--cycles 5000]

A hub of the socketcand protocol in this process plays NC and drives in lockstep; the guard runs as its own process and
is armed at the begin of a path. Prints a table. Loopback TCP is part of the figure.
"""

from __future__ import annotations

import argparse
import hashlib
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from fdhil.arming.guard_client import GuardClient
from fdhil.guard import guard_step
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.frame_monitor import FrameMonitor
from fdhil.guard.guard_settings import AxisSettings, GuardSettings, Pdo, encode_settings
from fdhil.guard.guard_state import GuardRequest, GuardState, StepInputs, make_initial_state
from fdhil.guard.interlocks import FACTS
from fdhil.guard.offset_limits import OffsetLimits

LIMITS = OffsetLimits(offset=819, rate=65, acceleration=6, variation=9830, window=1000)
ROWS = 20
TOKEN = "benchmark"


def make_axis(name: str, node: int) -> AxisSettings:
    """An axis with the default mapping."""
    tpdos = (
        Pdo(0x180 + node, ((0x6064, 0, 32, True), (0x606C, 0, 32, True))),
        Pdo(0x280 + node, ((0x6041, 0, 16, False), (0x6078, 0, 16, True), (0x2101, 0, 16, True))),
        Pdo(0x380 + node, ((0x6062, 0, 32, True), (0x60B0, 0, 32, True)), 10),
        Pdo(0x480 + node, ((0x60FD, 0, 32, False), (0x6061, 0, 8, True), (0x6077, 0, 16, True)), 10),
    )
    target = Pdo(0x200 + node, ((0x6040, 0, 16, False), (0x607A, 0, 32, True)))
    offset = Pdo(0x300 + node, ((0x60B0, 0, 32, True),))
    return AxisSettings(name, node, target, offset, tpdos, 3276.8, 500.0, 4000.0, 1, LIMITS, 32768, 2)


def make_settings(run_directory: str) -> GuardSettings:
    """Two axes in SYNC time."""
    digest = hashlib.sha256(TOKEN.encode()).hexdigest()
    axes = (make_axis("X", 1), make_axis("Y", 2))
    return GuardSettings("can0", "socketcand", 0.001, "sync", 0.020, 100, digest, run_directory, axes)


def make_frames(tick: int) -> list[tuple[int, bytes]]:
    """What drives and NC send after a SYNC, at rest at 0."""
    made = []
    for node in (1, 2):
        made += [(0x180 + node, bytes(8)), (0x280 + node, struct.pack("<Hi", 0x1237, 0))]
        if tick % 10 == 0:
            made += [(0x380 + node, bytes(8)), (0x480 + node, struct.pack("<Ibh", 0, 8, 0))]
        made.append((0x200 + node, struct.pack("<Hi", 0x0F, 0)))
    return made


def format_frames(what: list[tuple[int, bytes]]) -> bytes:
    """Frames in the socketcand protocol."""
    return b"".join(f"< frame {cob_id:03X} 1.0 {data.hex()} >".encode() for cob_id, data in what)


class Hub:
    """The bus: one client, the guard."""

    def __init__(self, client: socket.socket) -> None:
        self.client = client
        self.tick = 0

    def run_cycle(self, answers: int) -> float:
        """One SYNC; the seconds until ``answers`` offset frames came back, then the rest of the cycle."""
        self.tick += 1
        start_s = time.perf_counter()
        self.client.sendall(format_frames([(0x080, bytes([(self.tick - 1) % 240 + 1]))]))
        got = b""
        while got.count(b"send 30") < answers:
            got += self.client.recv(4096)
        taken_s = time.perf_counter() - start_s
        self.client.sendall(format_frames(make_frames(self.tick)))
        return taken_s


def measure_latencies(cycles: int) -> list[float]:
    """Seconds from SYNC to the second axis' offset frame, ``cycles`` of them, armed."""
    server = socket.create_server(("127.0.0.1", 0))
    with tempfile.TemporaryDirectory() as folder, server:
        far = socket.create_connection(server.getsockname())
        client, _ = server.accept()
        for end in (far, client):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        file = Path(folder) / "guard.json"
        file.write_text(encode_settings(make_settings(folder)))
        command = [sys.executable, "-m", "fdhil.guard", "--settings", str(file), "--descriptor", str(far.fileno())]
        with subprocess.Popen(command, pass_fds=[far.fileno()], stdout=subprocess.PIPE) as process, client:
            far.close()
            assert process.stdout is not None
            process.stdout.readline()
            with GuardClient(Path(folder)) as guard:
                taken = measure(Hub(client), guard, cycles)
            process.kill()
    return taken


def measure(hub: Hub, guard: GuardClient, cycles: int) -> list[float]:
    """Arm the guard and time its answers."""
    table = {name: [0] * ROWS for name in "XY"}
    guard.load_table("XY", table, table, "p")
    for _ in range(200):
        hub.run_cycle(0)
        time.sleep(0.001)
    answer: dict[str, object] = {}
    arming = threading.Thread(
        target=lambda: answer.update(guard.arm(TOKEN, "p", dict.fromkeys(FACTS, True))), daemon=True
    )
    arming.start()
    while arming.is_alive():
        hub.run_cycle(0)
        time.sleep(0.002)
    if not answer["ok"]:
        raise SystemExit(f"not armed: {answer}")
    time.sleep(0.1)
    hub.client.setblocking(False)
    try:
        while hub.client.recv(65536):
            pass
    except BlockingIOError:
        hub.client.setblocking(True)
    taken = []
    for k in range(cycles):
        if k % 50 == 0:
            guard.send_alive()
        taken.append(hub.run_cycle(2))
    return taken


def step_us(repeats: int = 2000) -> float:
    """Microseconds of processor time of one step while armed, two axes, the best of ten."""
    made = make_settings("")
    listener, state = FrameMonitor(made), make_initial_state(made)
    path = CorrectedPath(0, ([0] * ROWS,) * 2, ([0] * ROWS,) * 2, True, "p", 1)
    calls: list[tuple[GuardState, StepInputs]] = []
    for tick in range(1, 300):
        seen, bus = listener.receive_at_sync(bytes([(tick - 1) % 240 + 1]), tick * 1e-3, tick * 1e-3)
        request = GuardRequest("arm", True, "p", dict.fromkeys(FACTS, True)) if tick == 150 else None
        inputs = StepInputs(True, seen, bus, path=path, request=request)
        if tick > 160:
            calls.append((state, inputs))
        state, _ = guard_step.step_guard(state, inputs, made)
        for cob_id, data in make_frames(tick):
            listener.take_frame(cob_id, data, tick * 1e-3)
    best = float("inf")
    for _ in range(10):
        start_s = time.process_time()
        for k in range(repeats):
            guard_step.step_guard(*calls[k % len(calls)], made)
        best = min(best, (time.process_time() - start_s) / repeats)
    return best * 1e6


def main() -> None:
    """Run both figures and print them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--cycles", type=int, default=5000)
    options = parser.parse_args()
    taken = sorted(measure_latencies(options.cycles))
    result = {
        "latency_median_us": round(taken[len(taken) // 2] * 1e6, 1),
        "latency_p99_us": round(taken[int(len(taken) * 0.99)] * 1e6, 1),
        "latency_max_us": round(taken[-1] * 1e6, 1),
        "step_us": round(step_us(), 1),
        "cycles": options.cycles,
    }
    for name, value in result.items():
        print(f"{name:20} {value}")


if __name__ == "__main__":
    main()
