"""LinuxCNC with pid components and no CANopen drive: fdhil identifies, predicts and corrects by HAL pins only."""

from __future__ import annotations

import os
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.bridges import hal_bus
from fdhil.cli.demo.processes import ChildProcess
from fdhil.config.axis_section import HAL_INCREMENTS
from fdhil.daemon.daemon_socket import SOCKET_NAME
from fdhil.prediction import compute_contour_error_um
from fdhil.records import Float
from tests.free_ports import find_free_port
from tests.linuxcnc.cli_session import SHUTTLE, TRIES, is_pass_repeated, record_demand, run_fdhil, wait_for_state
from tests.linuxcnc.hal_machine import LEAD_CYCLES, HalMachine, HalTrace, build_document
from tests.linuxcnc.hal_plant import MOTOR, OTHERS, PITCH_MM

pytestmark = pytest.mark.debian
# the first move overcomes the friction of both axes, and lasts longer than the offsets' lead
PART = """G21 G90 G17 G64 P0.01
F9000
G1 X20 Y20
G1 Y75
G1 X80
G3 X120 I20
G1 X140
G1 X20 Y20
G1 X0 Y0
M2
"""
PLANTS: dict[str, tuple[dict[str, dict[str, float]], float]] = {  # and the minimum reduction of the contour error
    "benign": (dict.fromkeys("XY", MOTOR), 10.0),
    "realistic": (OTHERS, 4.0),
}
PER_MM = HAL_INCREMENTS / PITCH_MM


@dataclass
class HalRig:
    file: Path
    nc: HalMachine
    port: int

    def read_status(self) -> dict[str, Any]:
        return run_fdhil("status", self.file)

    def read_trace(self, cut: Callable[[], None]) -> tuple[Float, Float, Float]:
        """Return demand, position and applied offset (n, 2) in mm, from the first motion of ``cut`` on."""
        with HalTrace(self.port, 2) as trace:
            cut()
            time.sleep(0.5)  # the trace records LinuxCNC in real time
        demand, position, offset = trace.read_rows_mm()
        moving = np.flatnonzero(np.abs(np.diff(demand, axis=0)).max(axis=1) > 0)
        rows = slice(moving[0], moving[-1] + 300)
        return demand[rows], position[rows], offset[rows]


@pytest.fixture
def plant() -> str:
    return "benign"


@pytest.fixture
def hal_rig(tmp_path: Path, plant: str) -> Iterator[HalRig]:
    port, nc_port = find_free_port(), find_free_port()
    with HalMachine(tmp_path / "machine.toml", build_document(tmp_path, port, nc_port), PLANTS[plant][0]) as nc:
        nc.prioritise()
        yield HalRig(tmp_path / "machine.toml", nc, port)


def compute_rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("plant", PLANTS)
def test_second_cut_is_corrected_through_hal_pins(hal_rig: HalRig, plant: str, tmp_path: Path) -> None:
    motors, least_gain = PLANTS[plant]
    run_fdhil("commission", hal_rig.file, "--yes")
    part = tmp_path / "part.csv"
    with ExitStack() as stack:
        for name, command in (("guard", ["fdhil.cli.guard"]), ("daemon", ["fdhil", "run"])):
            started = stack.enter_context(ChildProcess(name, [*command, str(hal_rig.file)], tmp_path / f"{name}.log"))
            if name == "guard":
                hal_rig.nc.prioritise(started.pid)
        run_directory = machine_config.load_config(hal_rig.file).store.run_directory
        assert run_directory is not None
        wait_for_state((run_directory / SOCKET_NAME).exists)
        for _ in range(2):
            hal_rig.nc.run(SHUTTLE)
        wait_for_state(lambda: all(axis["accepted"] >= 4 for axis in hal_rig.read_status()["axes"].values()))
        for name, axis in hal_rig.read_status()["axes"].items():
            for symbol in ("R", "L", "K", "Jt"):
                assert axis["parameters"][symbol]["value"] == pytest.approx(motors[name][symbol], rel=0.05), symbol
        for tried in range(1, TRIES + 1):
            demand, position, _ = hal_rig.read_trace(
                lambda: record_demand(hal_rig.file, part, lambda: hal_rig.nc.run(PART))
            )
            before = compute_rms(compute_contour_error_um(demand, position, 0.001))
            run_fdhil("arm", hal_rig.file, part)
            demand, position, offset = hal_rig.read_trace(lambda: hal_rig.nc.run(PART))
            wait_for_state(lambda: len(hal_rig.read_status()["passes"]) == tried)  # noqa: B023 - called at once
            if is_pass_repeated(hal_rig.read_status()):
                break
        after = compute_rms(compute_contour_error_um(demand, position, 0.001))
        assert hal_rig.read_status()["counters"]["lost"] == 0
    first = int(np.flatnonzero(np.abs(offset).max(axis=1) > 0)[0])
    assert first == pytest.approx(LEAD_CYCLES, abs=5)
    assert after < before / least_gain, (before, after)


class InvalidClient:
    """A client of the bridge that sends arbitrary offsets."""

    def __init__(self, port: int) -> None:
        self.wire = socket.create_connection(("127.0.0.1", port))
        self.wire.sendall(b"< open hal >< rawmode >")
        self.rest = b""

    def send_offsets(self, cycles: int, offset_mm: Callable[[int], float | None]) -> list[float]:
        """Answer so many SYNCs with the offset of X and Y; return the offset applied to X in each cycle, mm."""
        applied: list[float] = []
        while len(applied) < cycles:
            *pieces, self.rest = (self.rest + self.wire.recv(1 << 16)).split(b">")
            for words in (piece.split() for piece in pieces):
                if len(words) < 5 or words[1] != b"frame":
                    continue
                cob_id, data = int(words[2], 16), bytes.fromhex(words[4].decode())
                if cob_id == hal_bus.TPDO3 + 1:
                    applied.append(struct.unpack("<ii", data)[1] / PER_MM)
                offset = offset_mm(len(applied)) if cob_id == hal_bus.SYNC else None
                if offset is not None:
                    frame = struct.pack("<iB", round(offset * PER_MM), data[0]).hex(" ")
                    for node in (1, 2):
                        self.wire.sendall(f"< send {hal_bus.RPDO2 + node:03X} 5 {frame} >".encode())
        return applied

    def close(self) -> None:
        self.wire.close()


@pytest.fixture
def invalid_client(hal_rig: HalRig) -> Iterator[InvalidClient]:
    client = InvalidClient(hal_rig.port)
    yield client
    client.close()


def test_limit3_bounds_every_offset(hal_rig: HalRig, invalid_client: InvalidClient) -> None:
    invalid_client.send_offsets(300, lambda _cycle: 0.0)
    applied = np.array(invalid_client.send_offsets(1500, lambda cycle: 40.0 * (-1) ** (cycle // 90)))
    limits = build_document(hal_rig.file.parent, 0, 0)["axis"]["X"]["correction"]
    rounding = 2 / PER_MM
    assert np.abs(applied).max() == pytest.approx(limits["max_offset_um"] * 1e-3, abs=rounding)
    speed, acceleration = np.diff(applied) / 1e-3, np.diff(applied, 2) / 1e-6
    assert np.abs(speed).max() <= 1.2 * limits["max_speed_mm_s"]
    assert np.abs(acceleration).max() <= 1.2 * limits["max_acceleration_mm_s2"] + 4 * rounding / 1e-6


@pytest.mark.fault("E8")
@pytest.mark.parametrize("fault", ["silence", "end", "abort and estop"])
def test_hal_ramps_offset_to_zero(hal_rig: HalRig, invalid_client: InvalidClient, fault: str) -> None:
    invalid_client.send_offsets(300, lambda _cycle: 0.0)
    held = invalid_client.send_offsets(700, lambda _cycle: 0.05)
    assert held[-1] == pytest.approx(0.05, abs=1e-4)
    if fault == "abort and estop":  # offsets are still sent
        hal_rig.nc.send_order("estop")
        left = invalid_client.send_offsets(1500, lambda _cycle: 0.05)
    elif fault == "end":
        invalid_client.close()
        other = InvalidClient(hal_rig.port)
        left = other.send_offsets(1500, lambda _cycle: None)
        other.close()
    else:
        left = invalid_client.send_offsets(1500, lambda _cycle: None)
    assert set(left[-200:]) == {0.0}


def read_syncs(client: InvalidClient, count: int) -> list[tuple[int, int]]:
    """Return cycle (by the stamp) and counter of the next SYNCs."""
    found: list[tuple[int, int]] = []
    while len(found) < count:
        *pieces, client.rest = (client.rest + client.wire.recv(1 << 16)).split(b">")
        for words in (piece.split() for piece in pieces):
            if len(words) == 5 and words[2] == b"080":
                found.append((round(float(words[3]) * 1000), int(words[4], 16)))
    return found


def test_dropped_samples_are_gap_of_their_size(hal_rig: HalRig, invalid_client: InvalidClient) -> None:
    (bridge,) = hal_rig.nc.find_pids(hal_bus.__file__)
    before = read_syncs(invalid_client, 100)
    os.kill(bridge, signal.SIGSTOP)
    time.sleep(1.3 * hal_bus.DEPTH / 1000)  # longer than the sampler has room for
    os.kill(bridge, signal.SIGCONT)
    seen = np.array(before + read_syncs(invalid_client, hal_bus.DEPTH + 1000))
    cycles, counters = np.diff(seen[:, 0]), np.diff(seen[:, 1]) % hal_bus.SYNC_RANGE
    assert np.count_nonzero(cycles > 1) == 1
    assert (cycles % hal_bus.SYNC_RANGE == counters).all()
