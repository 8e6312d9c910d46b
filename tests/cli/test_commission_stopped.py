"""A trial that is interrupted during a rapid: the axis is braked, then switched off."""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest

from tests.sim.simulator_process import SimulatorProcess, write_config

pytestmark = pytest.mark.usefixtures("processes")

# a trial with shorter waits than on a real machine, as a process of its own
QUICK = """
import importlib
for module, name, value in (
    ("drive_survey", "LISTEN_S", 0.3), ("commissioning_steps", "SETTLE_CYCLES", 120),
    ("commissioning_steps", "AVERAGE_CYCLES", 60),
    ("axis_trial", "TIMING_CYCLES", 100), ("axis_trial", "LAST_REST_S", 0.4), ("stroke_planning", "JOG_MM", 1.0),
):
    setattr(importlib.import_module("fdhil.commissioning." + module), name, value)
from fdhil.cli.main import main
main()
"""
PER_MM = 65536 / 20.0
ACCELERATION = 4000.0 * 1e-6 * PER_MM  # increments per cycle squared
PATIENCE_S = 300.0


@pytest.fixture(scope="module")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[SimulatorProcess, Path]]:
    folder = tmp_path_factory.mktemp("twin")
    with SimulatorProcess(write_config(folder, axes="X")) as running:
        joined = folder / "joined"
        joined.mkdir()
        file = write_config(joined, bus=f'interface = "socketcand"\nport = {running.bus_settings["port"]}', axes="X")
        file.write_text('[guard]\nclock = "sync"\n[play]\nheartbeat_s = 1.0\n' + file.read_text())
        yield running, file


@contextmanager
def start_rapid(
    twin: tuple[SimulatorProcess, Path],
) -> Iterator[tuple[subprocess.Popen[str], Callable[[], can.Message]]]:
    running, file = twin
    command = [sys.executable, "-c", QUICK, "commission", str(file), "--yes", "--room", "-2", "150"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with running.join_bus() as bus, process:
        deadline = time.monotonic() + PATIENCE_S

        def heard() -> can.Message:
            while time.monotonic() < deadline:
                if (frame := bus.recv(5.0)) is not None:
                    return frame
            raise AssertionError("it is not heard")

        begun = None
        while True:
            target = decode_target(heard())
            begun = target if begun is None else begun
            if target is not None and begun is not None and abs(target - begun) > 40.0 * PER_MM:
                break
            assert process.poll() is None, process.communicate()
        yield process, heard


def decode_target(frame: can.Message) -> int | None:
    return struct.unpack("<Hi", frame.data)[1] if frame.arbitration_id == 0x201 else None


def test_interrupted_trial_brakes_and_switches_drive_off(simulator: tuple[SimulatorProcess, Path]) -> None:
    with start_rapid(simulator) as (process, heard):
        process.send_signal(signal.SIGTERM)
        targets: list[int] = []
        words = [0x0F]
        while True:
            frame = heard()
            if (target := decode_target(frame)) is not None:
                targets.append(target)
                words.append(struct.unpack_from("<H", frame.data)[0])
                if len(targets) == 60:  # a second signal does not interrupt the braking
                    process.send_signal(signal.SIGINT)
            if frame.arbitration_id == 0x000:
                break
        _, err = process.communicate()
    assert (process.returncode, "Traceback" in err) == (130, False), err
    assert err.strip().endswith("stopped by the operator")
    assert np.abs(np.diff(targets, 2)).max() <= ACCELERATION + 2.0
    assert targets[-1] == targets[-60]
    still = next(k for k in range(len(targets)) if targets[k] == targets[-1])
    assert set(words[1 : still + 1]) == {0x0F}  # braked before switched off
    assert words[-1] == 0
