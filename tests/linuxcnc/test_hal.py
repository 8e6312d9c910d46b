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
from tests.linuxcnc.beside import SHUTTLE, TRIES, fdhil, record, repeated, until
from tests.linuxcnc.hal_machine import LEAD_CYCLES, HalMachine, HalTrace, document
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
class HalShop:
    file: Path
    nc: HalMachine
    port: int

    def status(self) -> dict[str, Any]:
        return fdhil("status", self.file)

    def trace(self, cut: Callable[[], None]) -> tuple[Float, Float, Float]:
        """Return demand, position and applied offset (n, 2) in mm, from the first motion of ``cut`` on."""
        with HalTrace(self.port, 2) as trace:
            cut()
            time.sleep(0.5)  # the trace records LinuxCNC in real time
        demand, position, offset = trace.rows_mm()
        moving = np.flatnonzero(np.abs(np.diff(demand, axis=0)).max(axis=1) > 0)
        rows = slice(moving[0], moving[-1] + 300)
        return demand[rows], position[rows], offset[rows]


@pytest.fixture
def plant() -> str:
    return "benign"


@pytest.fixture
def shop(tmp_path: Path, plant: str) -> Iterator[HalShop]:
    port, nc_port = find_free_port(), find_free_port()
    with HalMachine(tmp_path / "machine.toml", document(tmp_path, port, nc_port), PLANTS[plant][0]) as nc:
        nc.prioritise()
        yield HalShop(tmp_path / "machine.toml", nc, port)


def rms(values: Float) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("plant", PLANTS)
def test_the_second_cut_is_corrected_by_hal_pins_alone(shop: HalShop, plant: str, tmp_path: Path) -> None:
    motors, least_gain = PLANTS[plant]
    fdhil("commission", shop.file, "--yes")
    part = tmp_path / "part.csv"
    with ExitStack() as stack:
        for name, command in (("guard", ["fdhil.cli.guard"]), ("daemon", ["fdhil", "run"])):
            started = stack.enter_context(ChildProcess(name, [*command, str(shop.file)], tmp_path / f"{name}.log"))
            if name == "guard":
                shop.nc.prioritise(started.pid)
        run_directory = machine_config.load_config(shop.file).store.run_directory
        assert run_directory is not None
        until((run_directory / SOCKET_NAME).exists)
        for _ in range(2):
            shop.nc.run(SHUTTLE)
        until(lambda: all(axis["accepted"] >= 4 for axis in shop.status()["axes"].values()))
        for name, axis in shop.status()["axes"].items():
            for symbol in ("R", "L", "K", "Jt"):
                assert axis["parameters"][symbol]["value"] == pytest.approx(motors[name][symbol], rel=0.05), symbol
        for tried in range(1, TRIES + 1):
            demand, position, _ = shop.trace(lambda: record(shop.file, part, lambda: shop.nc.run(PART)))
            before = rms(compute_contour_error_um(demand, position, 0.001))
            fdhil("arm", shop.file, part)
            demand, position, offset = shop.trace(lambda: shop.nc.run(PART))
            until(lambda: len(shop.status()["passes"]) == tried)  # noqa: B023 - called at once
            if repeated(shop.status()):
                break
        after = rms(compute_contour_error_um(demand, position, 0.001))
        assert shop.status()["counters"]["lost"] == 0
    first = int(np.flatnonzero(np.abs(offset).max(axis=1) > 0)[0])
    assert first == pytest.approx(LEAD_CYCLES, abs=5)
    assert after < before / least_gain, (before, after)


class Nonsense:
    """A client of the bridge that sends arbitrary offsets."""

    def __init__(self, port: int) -> None:
        self.wire = socket.create_connection(("127.0.0.1", port))
        self.wire.sendall(b"< open hal >< rawmode >")
        self.rest = b""

    def run(self, cycles: int, offset_mm: Callable[[int], float | None]) -> list[float]:
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
def nonsense(shop: HalShop) -> Iterator[Nonsense]:
    client = Nonsense(shop.port)
    yield client
    client.close()


def test_limit3_holds_whatever_is_sent(shop: HalShop, nonsense: Nonsense) -> None:
    nonsense.run(300, lambda _cycle: 0.0)
    applied = np.array(nonsense.run(1500, lambda cycle: 40.0 * (-1) ** (cycle // 90)))
    limits = document(shop.file.parent, 0, 0)["axis"]["X"]["correction"]
    rounding = 2 / PER_MM
    assert np.abs(applied).max() == pytest.approx(limits["max_offset_um"] * 1e-3, abs=rounding)
    speed, acceleration = np.diff(applied) / 1e-3, np.diff(applied, 2) / 1e-6
    assert np.abs(speed).max() <= 1.2 * limits["max_speed_mm_s"]
    assert np.abs(acceleration).max() <= 1.2 * limits["max_acceleration_mm_s2"] + 4 * rounding / 1e-6


@pytest.mark.fault("E8")
@pytest.mark.parametrize("fault", ["silence", "end", "abort and estop"])
def test_hal_brings_the_offset_to_zero(shop: HalShop, nonsense: Nonsense, fault: str) -> None:
    nonsense.run(300, lambda _cycle: 0.0)
    held = nonsense.run(700, lambda _cycle: 0.05)
    assert held[-1] == pytest.approx(0.05, abs=1e-4)
    if fault == "abort and estop":  # offsets are still sent
        shop.nc.order("estop")
        left = nonsense.run(1500, lambda _cycle: 0.05)
    elif fault == "end":
        nonsense.close()
        other = Nonsense(shop.port)
        left = other.run(1500, lambda _cycle: None)
        other.close()
    else:
        left = nonsense.run(1500, lambda _cycle: None)
    assert set(left[-200:]) == {0.0}


def syncs(client: Nonsense, count: int) -> list[tuple[int, int]]:
    """Return cycle (by the stamp) and counter of the next SYNCs."""
    found: list[tuple[int, int]] = []
    while len(found) < count:
        *pieces, client.rest = (client.rest + client.wire.recv(1 << 16)).split(b">")
        for words in (piece.split() for piece in pieces):
            if len(words) == 5 and words[2] == b"080":
                found.append((round(float(words[3]) * 1000), int(words[4], 16)))
    return found


def test_samples_that_found_no_room_are_a_hole_of_their_size(shop: HalShop, nonsense: Nonsense) -> None:
    (bridge,) = shop.nc.pids_of(hal_bus.__file__)
    before = syncs(nonsense, 100)
    os.kill(bridge, signal.SIGSTOP)
    time.sleep(1.3 * hal_bus.DEPTH / 1000)  # longer than the sampler has room for
    os.kill(bridge, signal.SIGCONT)
    seen = np.array(before + syncs(nonsense, hal_bus.DEPTH + 1000))
    cycles, counters = np.diff(seen[:, 0]), np.diff(seen[:, 1]) % hal_bus.SYNC_RANGE
    assert np.count_nonzero(cycles > 1) == 1
    assert (cycles % hal_bus.SYNC_RANGE == counters).all()
