"""Moves the NC along a path on the SYNC grid: a rapid to its start, then its rows at a variable rate."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fdhil.records import Bool, Float, Trajectory
from fdhil.sim.nc.demand_stream import DemandStream

NEGLIGIBLE_MM = 1e-9  # far below an increment of any drive


class PathRow(NamedTuple):
    """The command for one SYNC: position (mm per axis), whether it is a rapid, whether it belongs to a played file."""

    position_mm: list[float]
    rapid: bool
    playing: bool


def plan_rapid_rows(
    start_mm: Sequence[float],
    end_mm: Sequence[float],
    speed_mm_s: Sequence[float],
    acceleration_mm_s2: Sequence[float],
    smoothing_s: Sequence[float],
    period_s: float,
) -> Float:
    """Return the rows (n, axes) of a straight rapid: a trapezoid in time, smoothed by causal moving averages.

    The slowest axis sets the pace; the first row is the start, the last one the end. Empty (0, axes) without motion.
    """
    start, end = np.asarray(start_mm, dtype=float), np.asarray(end_mm, dtype=float)
    distance = np.abs(end - start)
    moving = distance > NEGLIGIBLE_MM
    if not moving.any():
        return np.empty((0, start.size))
    speed = float(np.min(np.asarray(speed_mm_s)[moving] / distance[moving]))  # shares of the path per second
    acceleration = float(np.min(np.asarray(acceleration_mm_s2)[moving] / distance[moving]))
    speed = min(speed, math.sqrt(acceleration))  # a path too short for the rapid speed: a triangle
    ramp_s, total_s = speed / acceleration, 1 / speed + speed / acceleration
    t = np.arange(math.ceil(total_s / period_s) + 1) * period_s
    t = np.minimum(t, total_s)
    part = np.where(t < ramp_s, acceleration * t**2 / 2, speed * (t - ramp_s / 2))
    part = np.where(t > total_s - ramp_s, 1 - acceleration * (total_s - t) ** 2 / 2, part)
    for window_s in smoothing_s:
        width = round(window_s / period_s)
        if width > 1:
            padded = np.concatenate([np.zeros(width - 1), part, np.ones(width - 1)])
            part = np.convolve(padded, np.full(width, 1 / width), mode="valid")
    rows = start + np.outer(part, end - start)
    rows[-1] = end
    return rows


class PathRate:
    """The path's rate, 1 for 100 %: follows a target with limited, rounded slope, for override and feed hold.

    ``slope_per_s`` limits its change, so that a machine in rapid never exceeds its acceleration.
    """

    def __init__(self, slope_per_s: float, period_s: float) -> None:
        self._step = slope_per_s * period_s
        self._linear = 1.0
        width = max(1, round(1 / (3 * self._step)))
        self._window: deque[float] = deque([1.0] * width, maxlen=width)
        self._settled = 0
        self.value = 1.0

    def jump_to(self, value: float) -> None:
        """Set the rate at once, while the path is at rest."""
        self._linear = self.value = value
        self._window.extend([value] * len(self._window))

    def advance_rate(self, target: float) -> float:
        """Advance one cycle toward ``target`` and return the rate."""
        if self._linear == target and self._settled > len(self._window):
            return self.value
        self._settled = self._settled + 1 if self._linear == target else 0
        gap = target - self._linear
        self._linear = target if abs(gap) <= self._step else self._linear + math.copysign(self._step, gap)
        self._window.append(self._linear)
        mean = math.fsum(self._window) / len(self._window)
        self.value = target if self._settled >= len(self._window) else mean
        return self.value


class RowPlayer:
    """Plays rows (n, axes) at a rate: whole rows exactly, with cubic interpolation between them."""

    def __init__(self, rows: Float, rapid: Bool) -> None:
        self._rows = np.ascontiguousarray(rows, dtype=float)
        self._rapid = rapid
        self._last = len(rows) - 1
        self._at = 0.0

    @property
    def has_ended(self) -> bool:
        return self._at > self._last

    def play_row(self, rate: float) -> tuple[list[float], bool]:
        """Return the position (mm per axis) and whether it is a rapid, then advance by ``rate`` rows."""
        at = min(self._at, float(self._last))
        row = int(at)
        part = at - row
        position = self._rows[row].tolist() if part == 0.0 else self._interpolate_row(row, part)
        # the last row is always played exactly, whatever the rate
        self._at = self._last if at < self._last < at + rate else self._at + rate
        return position, bool(self._rapid[row])

    def _interpolate_row(self, row: int, part: float) -> list[float]:
        before, here = self._rows[max(row - 1, 0)].tolist(), self._rows[row].tolist()
        after, beyond = self._rows[row + 1].tolist(), self._rows[min(row + 2, self._last)].tolist()
        return [
            p1 + 0.5 * part * (p2 - p0 + part * (2 * p0 - 5 * p1 + 4 * p2 - p3 + part * (3 * (p1 - p2) + p3 - p0)))
            for p0, p1, p2, p3 in zip(before, here, after, beyond, strict=True)
        ]


@dataclass(slots=True)
class Pause:
    cycles: int

    @property
    def has_ended(self) -> bool:
        return self.cycles <= 0


@dataclass(slots=True)
class PathStage:
    """A part of the path: a motion or a rest, and whether it belongs to the played file."""

    motion: RowPlayer | DemandStream | Pause
    playing: bool = False


@dataclass(slots=True)
class PlayJob:
    """A file to be played, with its demand or the stream that brings it."""

    file: str
    demand: Trajectory | DemandStream

    @property
    def rows(self) -> int | None:
        """The number of rows, None for a stream."""
        return None if isinstance(self.demand, DemandStream) else self.demand.time_s.size

    def explain_refusal(self, axes: Sequence[str], period_s: float) -> str:
        """Return why a machine with these axes and this SYNC period cannot play it, "" where it can."""
        if isinstance(self.demand, DemandStream):
            return ""
        if unknown := [axis for axis in self.demand.axes if axis not in axes]:
            return f"this machine has no axis {', '.join(unknown)}"
        if abs(self.demand.dt_s - period_s) > 1e-9:
            return f"its rows are {self.demand.dt_s:g} s apart, the SYNC period is {period_s:g} s"
        return "" if self.demand.time_s.size else "it has no rows"

    @property
    def is_awaited(self) -> bool:
        return isinstance(self.demand, DemandStream) and not self.demand.rows and not self.demand.has_ended

    def create_finished_event(self, played: int, stopped: bool) -> dict[str, Any]:
        """Return the event of its end: ``played`` rows, including the rest after it, until it ended or was stopped."""
        if isinstance(self.demand, DemandStream):
            what = {"rows": self.demand.rows, "starved": self.demand.starved}
        else:
            what = {"rows": min(played, self.demand.time_s.size) if stopped else self.demand.time_s.size}
        return {"event": "finished", "file": self.file, "stopped": stopped, **what}
