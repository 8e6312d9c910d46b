"""A simulated machine for daemon tests: its drive is the nominal one, moving back and forth at rapid speed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.daemon.kernel_warmup import simulate_nominal_rapid
from fdhil.errors import ConnectError
from fdhil.pipeline import Record
from fdhil.records import AxisSamples, MoveEvent, MoveKind, NcState, Notice, TickTimes, freeze_array, freeze_integers
from tests.bench import AXIS, bench_axis

NOMINAL = AXIS["nominal"]


def config_of(folder: Path, axes: Sequence[str] = ("X",), **sections: Any) -> MachineConfig:
    document = {"machine": {"name": "bench"}, "axis": dict.fromkeys(axes, bench_axis()), **sections}
    return machine_config.parse_config(document, "test", folder)


def rapids(config: MachineConfig, axis: str = "X", count: int = 2, first_tick: int = 0) -> list[Record]:
    """Return the records of ``count`` rapids, back and forth, in blocks of 40 samples, with 0.4 s of standstill."""
    dt_s = config.machine.sync_period_s
    windows = [simulate_nominal_rapid(axis, config.axis[axis], dt_s, 1 if k % 2 == 0 else -1) for k in range(count)]
    rest = round(0.4 / dt_s)
    rng = np.random.default_rng(3)
    signals: dict[str, list[Any]] = {
        name: [] for name in ("demand_mm", "position_mm", "speed_rad_s", "current_a", "voltage_v")
    }
    events: list[MoveEvent] = []
    place, tick = 0.0, first_tick
    for window in windows:
        base = {"demand_mm": place, "position_mm": place}
        noise = {"speed_rad_s": 0.15, "current_a": 0.05, "voltage_v": 0.06}
        for name, parts in signals.items():
            values = getattr(window, name)
            still = np.full(rest, float(values[0]) if name in base else 0.0) + rng.normal(0, noise.get(name, 0.0), rest)
            parts += [still + base.get(name, 0.0), values + base.get(name, 0.0)]
        begin, end = window.stages.accelerate, window.stages.brake
        assert begin is not None
        assert end is not None
        events.append(MoveEvent(axis, MoveKind.RAPID, tick + rest + begin[0], "test"))
        events.append(MoveEvent(axis, MoveKind.REST, tick + rest + end[1], "test"))
        place += float(window.position_mm[-1])
        tick += rest + window.n
    joined = {name: np.concatenate([*parts, parts[-1][-1:].repeat(rest)]) for name, parts in signals.items()}
    return _blocks(axis, joined, events, first_tick, dt_s)


def _blocks(axis: str, signals: dict[str, Any], events: list[MoveEvent], first_tick: int, dt_s: float) -> list[Record]:
    records: list[Record] = []
    n = signals["speed_rad_s"].size
    for start in range(0, n, 40):
        part = slice(start, min(n, start + 40))
        tick = first_tick + np.arange(part.start, part.stop)
        records.append(TickTimes(freeze_integers(tick), freeze_integers(tick * round(dt_s * 1e9))))
        block: dict[str, Any] = {name: freeze_array(values[part]) for name, values in signals.items()}
        zeros = np.zeros(tick.size)
        records.append(
            AxisSamples(
                axis, freeze_integers(tick), offset_mm=freeze_array(zeros), statusword=freeze_integers(zeros), **block
            )
        )
        records += [event for event in events if tick[0] <= event.tick <= tick[-1]]
    return records


class SimulatedMachine:
    """A source that yields given records, and more when ``give`` is called; ``fail`` makes it fail."""

    def __init__(self, records: Sequence[Record | NcState | Notice] = ()) -> None:
        self.queue: asyncio.Queue[Record | NcState | Notice | Exception] = asyncio.Queue()
        self.opened = 0
        self.unreachable = 0
        self.taken = 0
        self.give(*records)

    def give(self, *records: Record | NcState | Notice | Exception) -> None:
        for record in records:
            self.queue.put_nowait(record)

    @asynccontextmanager
    async def open(self, config: MachineConfig) -> AsyncIterator[SimulatedMachine]:
        if self.unreachable > 0:
            self.unreachable -= 1
            raise ConnectError("can0", "cannot be reached; check the wiring")
        self.opened += 1
        yield self

    async def run(self, take: Callable[[Record | NcState | Notice], None]) -> None:
        while True:
            record = await self.queue.get()
            if isinstance(record, Exception):
                raise record
            self.taken += 1
            take(record)

    def dump_recent_frames(self) -> dict[str, str]:
        return {"can0": "(1.000000) can0 080#\n"}

    def get_counters(self) -> dict[str, int]:
        return {"frames": self.taken, "lost": 0}
