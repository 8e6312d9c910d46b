"""The black boxes as the browser has them: which there are, and the envelope of what the drives did in one."""

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic import BaseModel

from fdhil.config import MachineConfig
from fdhil.daemon.blackbox import FOLDER, kept
from fdhil.drivers.cia402.candump_samples import LARGEST_LOG, samples_of_log
from fdhil.records import AxisSamples, Float
from fdhil.store.named_file import open_named

COLUMNS = 400
"""Of an envelope: of each the least and the greatest are kept, so that no peak is lost."""
DIGITS = 6


class BlackBox(BaseModel):
    """The frames of the seconds around a trip: its file, when it was written, what the trip's class was."""

    name: str
    time: str
    code: str
    size_bytes: int


class Signal(BaseModel):
    """The least and the greatest value of each column of time; null where no sample came."""

    name: str
    unit: str
    low: list[float | None]
    high: list[float | None]


class AxisEnvelope(BaseModel):
    """What one axis did; ``time_s`` is before the end of the log."""

    axis: str
    time_s: list[float]
    samples: int
    lost_frames: int
    signals: list[Signal]


class Envelope(BaseModel):
    """What the drives did in a black box."""

    name: str
    axes: list[AxisEnvelope]


def listed(store: Path) -> list[BlackBox]:
    """Return the black boxes of a store, newest first; a file of another name is none."""
    return [
        BlackBox(
            name=box.path.name,
            time=box.written.isoformat(timespec="seconds"),
            code=box.code,
            size_bytes=box.path.stat().st_size,
        )
        for box in reversed(kept(store))
    ]


def opened(store: Path, name: str) -> BinaryIO:
    """Open a black box by a name from outside. StoreError when it is none."""
    return open_named(store / FOLDER, name)


def envelope(store: Path, name: str, config: MachineConfig) -> Envelope:
    """Return what the drives did in a black box. StoreError, RecordingError."""
    with opened(store, name) as file:
        found = samples_of_log(file.read(LARGEST_LOG + 1), config)
    last = max((int(samples.tick[-1]) for samples in found.values()), default=0)
    period_s = config.machine.sync_period_s
    return Envelope(name=name, axes=[_axis(samples, last, period_s) for samples in found.values()])


def _axis(samples: AxisSamples, last_tick: int, period_s: float) -> AxisEnvelope:
    signals = {
        ("following_error", "um"): (samples.demand_mm + samples.offset_mm - samples.position_mm) * 1e3,
        ("offset", "um"): samples.offset_mm * 1e3,
        ("speed", "rad/s"): samples.speed_rad_s,
        ("current", "A"): samples.current_a,
    }
    if samples.voltage_v is not None:
        signals["voltage", "V"] = samples.voltage_v
    first = int(samples.tick[0])
    per = max(1, math.ceil((last_tick + 1 - first) / COLUMNS))
    column = (samples.tick - first) // per
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    time_s: Float = np.asarray((first + column[starts] * per - last_tick) * period_s, np.float64)
    return AxisEnvelope(
        axis=samples.axis,
        time_s=_short(time_s),
        samples=samples.tick.size,
        lost_frames=samples.lost,
        signals=[
            Signal(name=name, unit=unit, low=_least(values, starts, 1.0), high=_least(values, starts, -1.0))
            for (name, unit), values in signals.items()
        ],
    )


def _least(values: Float, starts: Any, sign: float) -> list[float | None]:
    least: Float = np.fmin.reduceat(sign * values, starts)
    return _short(sign * least)


def _short(values: Float) -> list[Any]:
    return [float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None for value in values.tolist()]
