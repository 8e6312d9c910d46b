"""The black boxes for the browser: their list, and the envelope of the drives' signals in one of them."""

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from pydantic import BaseModel

from fdhil.config import MachineConfig
from fdhil.daemon import BLACK_BOX_FOLDER, find_black_boxes
from fdhil.drivers import LARGEST_LOG, decode_candump
from fdhil.records import AxisSamples, Float
from fdhil.store import open_named
from fdhil.web.pages.rapid_signals import round_digits

COLUMNS = 400
"""Columns of an envelope: minimum and maximum of each are kept, so that no peak is lost."""


class BlackBox(BaseModel):
    """The frames of the seconds around a trip: its file, its time, and the trip's code."""

    name: str
    time: str
    code: str
    size_bytes: int


class Signal(BaseModel):
    """The minimum and maximum in each column of time; null without samples."""

    name: str
    unit: str
    low: list[float | None]
    high: list[float | None]


class AxisEnvelope(BaseModel):
    """The signals of one axis; ``time_s`` is relative to the end of the log."""

    axis: str
    time_s: list[float]
    samples: int
    lost_frames: int
    signals: list[Signal]


class Envelope(BaseModel):
    """The drives' signals in a black box."""

    name: str
    axes: list[AxisEnvelope]


def summarise_black_boxes(store: Path) -> list[BlackBox]:
    """Return the black boxes of a store, newest first; files with other names are ignored."""
    return [
        BlackBox(
            name=box.path.name,
            time=box.written.isoformat(timespec="seconds"),
            code=box.code,
            size_bytes=box.path.stat().st_size,
        )
        for box in reversed(find_black_boxes(store))
    ]


def open_black_box(store: Path, name: str) -> BinaryIO:
    """Open a black box by a name from outside. Raises StoreError if it is none."""
    return open_named(store / BLACK_BOX_FOLDER, name)


def make_envelope(store: Path, name: str, config: MachineConfig) -> Envelope:
    """Return the drives' signals in a black box. Raises StoreError, RecordingError."""
    with open_black_box(store, name) as file:
        found = decode_candump(file.read(LARGEST_LOG + 1), config)
    last = max((int(samples.tick[-1]) for samples in found.values()), default=0)
    period_s = config.machine.sync_period_s
    return Envelope(name=name, axes=[_make_axis_envelope(samples, last, period_s) for samples in found.values()])


def _make_axis_envelope(samples: AxisSamples, last_tick: int, period_s: float) -> AxisEnvelope:
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
        time_s=round_digits(time_s),
        samples=samples.tick.size,
        lost_frames=samples.lost,
        signals=[
            Signal(
                name=name,
                unit=unit,
                low=_compute_extremes(values, starts, 1.0),
                high=_compute_extremes(values, starts, -1.0),
            )
            for (name, unit), values in signals.items()
        ],
    )


def _compute_extremes(values: Float, starts: Any, sign: float) -> list[float | None]:
    """Return the minimum (``sign`` 1) or the maximum (-1) of each column."""
    least: Float = np.fmin.reduceat(sign * values, starts)
    return round_digits(sign * least)
