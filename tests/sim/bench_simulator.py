"""The bench machine as a simulator in this process, and references to play on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fdhil import config
from fdhil.config import MachineConfig
from fdhil.records import Float, Trajectory, freeze_array
from fdhil.sim.frame_types import Frame
from fdhil.sim.simulated_machine import SimulatedMachine
from tests.bench import bench_document

PERIOD_S = 0.001


def build_simulator_config(
    axes: str = "XY", *, sim: Mapping[str, Any] | None = None, **axis_keys: Any
) -> MachineConfig:
    """Return the bench's configuration with a [sim] section and keys for every axis."""
    document = bench_document(axes)
    for axis in document["axis"].values():
        axis.update(axis_keys)
    document["sim"] = {"noise": {"voltage_v": 0.0, "current_a": 0.0, "speed_rad_s": 0.0}, **(sim or {})}
    return config.parse_config(document)


def smooth_rows(points_mm: Float, widths: tuple[int, ...] = (60, 30)) -> Float:
    """Return (n, axes) rows smoothed by moving averages, as an NC does."""
    for width in widths:
        padded = np.vstack([np.repeat(points_mm[:1], width - 1, 0), points_mm, np.repeat(points_mm[-1:], width - 1, 0)])
        kernel = np.ones(width) / width
        points_mm = np.column_stack([np.convolve(column, kernel, mode="valid") for column in padded.T])
    return points_mm


def build_corner_rows(speed_mm_s: float = 150.0, side_mm: float = 20.0) -> Float:
    """Return the rows (n, 2) of an L: up along Y, then along X."""
    steps = round(side_mm / (speed_mm_s * PERIOD_S))
    way = np.linspace(0.0, side_mm, steps + 1)
    up = np.column_stack([np.zeros_like(way), way])
    along = np.column_stack([way[1:], np.full(steps, side_mm)])
    return smooth_rows(np.vstack([up, along]))


def build_trajectory(rows_mm: Float, axes: str = "XY", rapid: bool = False) -> Trajectory:
    n = len(rows_mm)
    return Trajectory(
        PERIOD_S,
        freeze_array(np.arange(n) * PERIOD_S),
        {axis: freeze_array(rows_mm[:, place]) for place, axis in enumerate(axes)},
        np.full(n, rapid),
        np.zeros(n, dtype=np.int64),
    )


class SteppedSimulator:
    """A machine advanced cycle by cycle; ``wire`` keeps every frame in order, ``events`` its events."""

    def __init__(self, machine_config: MachineConfig) -> None:
        self.machine = SimulatedMachine(machine_config)
        self.wire: list[Frame] = [frame for _, frame in self.machine.power_on()]
        self.events: list[dict[str, Any]] = []
        self.table: list[list[float]] = []
        self.each_cycle: Callable[[], None] = lambda: None

    def run_cycles(self, cycles: int) -> None:
        for _ in range(cycles):
            self.wire += [frame for _, frame in self.machine.run_nc_cycle()]
            self.events += self.machine.take_events()
            self.table.append([unit.drive.table_mm for unit in self.machine.units.values()])
            self.each_cycle()

    def run_until(self, event: str, limit: int = 20000) -> dict[str, Any]:
        """Run until an event of this name and return it."""
        for _ in range(limit):
            known = len(self.events)
            self.run_cycles(1)
            for item in self.events[known:]:
                if item["event"] == event:
                    return item
        raise AssertionError(f"no {event} within {limit} cycles: {self.events}")

    def send_frame(self, can_id: int, data: bytes) -> list[Frame]:
        """Send a frame as another party and return the answers."""
        return self.machine.receive_frame("can0", (can_id, data))

    def switch_on(self) -> None:
        self.machine.nc.switch_on_off(True)
        self.run_until("nc")

    def play_rows(self, rows_mm: Float, **keys: Any) -> None:
        self.machine.nc.play_demand("rows", build_trajectory(rows_mm, **keys))


def list_targets(wire: list[Frame], node_id: int) -> list[tuple[int, int]]:
    """Return (controlword, target) of every RPDO1 of a node on the bus."""
    found = [data for can_id, data in wire if can_id == 0x200 + node_id]
    return [(int.from_bytes(d[:2], "little"), int.from_bytes(d[2:], "little", signed=True)) for d in found]
