"""How late the SYNC of fdhil play leaves, beside a loop in C that only sleeps and wakes.

    python -m benchmarks.play_jitter [--seconds 60] [--period-ms 1] [--interface vcan0]

The simulated machine (a process of its own) is on a hub, or on the interface of the kernel where one is named; its
drives are signed off, and a demand of both axes is played to them as ``fdhil play`` does.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fdhil import config
from tests.integration.conftest import sign_off
from tests.sim.simulator_process import write_config

HERE = Path(__file__).parent
SETPOINTS = "[axis.{}.setpoints]\ntravel_mm = [-50.0, 50.0]\n"
HEARTBEAT = "[play]\nheartbeat_s = 0.2\n"  # it is the lateness that is asked for, and not whether a drive bears it
DRIVES_PRIORITY = 40  # a real drive has a processor of its own


def floor(period_ms: float, seconds: float, folder: Path) -> str:
    """Compile and run the loop in C; p50, p99 and max in us, and its scheduling."""
    program = folder / "sleep_floor"
    subprocess.run(["cc", "-O2", "-o", program, HERE / "sleep_floor.c"], check=True)
    cycles = round(seconds / period_ms * 1e3)
    arguments = [program, str(round(period_ms * 1e3)), str(cycles)]
    return subprocess.run(arguments, check=True, capture_output=True, text=True).stdout.strip()


def prefer() -> None:
    """Run the simulated drives before all ordinary work, where this user may."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(DRIVES_PRIORITY))


@contextlib.contextmanager
def machine(folder: Path, period_ms: float, interface: str | None, lockstep: bool) -> Iterator[Path]:
    """Run the simulated machine; yields the path of the config with which others join it."""
    bus = f'interface = "socketcan"\nchannel = "{interface}"' if interface else 'interface = "socketcand"\nport = 0'
    path = write_config(folder, bus=bus, sim="modbus = false")
    text = path.read_text() + SETPOINTS.format("X") + SETPOINTS.format("Y") + HEARTBEAT
    text += '[guard]\nclock = "sync"\n' if lockstep else ""
    text = text.replace("sync_period_s = 0.001", f"sync_period_s = {period_ms / 1e3:g}")
    path.write_text(text)
    command = [sys.executable, "-m", "fdhil", "sim", str(path), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True, preexec_fn=prefer) as sim:
        assert sim.stdout is not None
        ready = json.loads(sim.stdout.readline())
        path.write_text(text.replace("port = 0", f"port = {ready['buses']['can0'].get('port')}"))
        sign_off(config.load_config(path))
        yield path
        sim.terminate()


def demand(path: Path, seconds: float, period_ms: float) -> None:
    """Both axes on a circle of 20 mm, in at least two seconds a turn, from rest to rest."""
    turns = max(1, round(seconds / 2))
    time_s = np.arange(round(seconds / period_ms * 1e3) + 1) * period_ms / 1e3
    share = time_s / time_s[-1]
    angle = 2 * np.pi * turns * (share - np.sin(2 * np.pi * share) / (2 * np.pi) / turns)
    rows = np.column_stack([time_s, 20 * (1 - np.cos(angle)), 20 * np.sin(angle) * np.sin(np.pi * share)])
    np.savetxt(path, rows, delimiter=",", fmt=["%.6f", "%.6f", "%.6f"], header="time_s,X_mm,Y_mm", comments="")


def play(path: Path, program: Path) -> dict[str, Any]:
    """Play, and return what it says."""
    command = [sys.executable, "-m", "fdhil", "play", str(program), "--config", str(path), "--yes", "--go-to-start"]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        sys.exit(done.stdout + done.stderr)
    message: dict[str, Any] = json.loads(done.stdout)
    return message


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--period-ms", type=float, default=1.0)
    parser.add_argument("--interface")
    parser.add_argument("--lockstep", action="store_true", help="wait for drives that sleep: periods missed")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        where = given.interface or "a hub on 127.0.0.1"
        print(f"SYNC every {given.period_ms:g} ms for {given.seconds:g} s, two drives on {where}")
        print(f"sleep and wake in C: {floor(given.period_ms, min(given.seconds, 30.0), folder)} (p50 p99 max, us)")
        program = folder / "circle.csv"
        demand(program, given.seconds, given.period_ms)
        with machine(folder, given.period_ms, given.interface, given.lockstep) as path:
            message = play(path, program)
        if "refused" in message:
            sys.exit(message["refused"])
        sync = message["sync"]
        print(
            f"fdhil play: {sync['late_p50_us']:.0f} {sync['late_p99_us']:.0f} {sync['late_max_us']:.0f} "
            f"{sync['scheduling']} (p50 p99 max, us); {sync['skipped']} of {sync['cycles']} periods missed; "
            f"{message['played']} of {message['rows']} rows, stopped: {message['stopped']}"
        )


if __name__ == "__main__":
    main()
