"""Says what a process uses, from outside, and how steeply a series of such figures grows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Floats = Sequence[float] | NDArray[np.float64]
BLOCKS = 8  # a series is taken together in so many parts: neighbouring samples know of each other


@dataclass(frozen=True, slots=True)
class Used:
    """What one process uses: resident memory and the anonymous part of it, descriptors, threads, children."""

    resident_mb: float
    anonymous_mb: float
    descriptors: int
    threads: int
    children: int
    zombies: int


def measure_usage(pid: int) -> Used:
    """Return what a process uses now; OSError when it is gone."""
    reported = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text("utf-8").splitlines())
    if "VmRSS" not in reported:  # it has ended, and nobody has waited for it yet
        raise ProcessLookupError(pid)
    resident, anonymous = (int(reported[name].split()[0]) / 1024 for name in ("VmRSS", "RssAnon"))
    states = list_children(pid)
    return Used(
        resident,
        anonymous,
        len(list(Path(f"/proc/{pid}/fd").iterdir())),
        int(reported["Threads"]),
        len(states),
        states.count("Z"),
    )


def list_children(pid: int) -> list[str]:
    """Return the states of a process' children, Z of one that nobody has waited for."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                fields = (folder / "stat").read_text("utf-8").rpartition(")")[2].split()
            except OSError:  # it has ended meanwhile
                continue
            if int(fields[1]) == pid:
                found.append(fields[0])
    return found


def measure_size_mb(path: Path) -> float:
    """Return what a file, or all files below a folder, hold."""
    files = [path] if path.is_file() else path.rglob("*")
    total = 0
    for file in files:
        try:
            total += file.stat().st_size if file.is_file() else 0
        except OSError:  # it was removed meanwhile
            continue
    return total / 1e6


@dataclass(frozen=True, slots=True)
class Slope:
    """How steeply something grows per unit of what it is laid over; it lies between low and high in 95 of 100 cases."""

    value: float
    low: float
    high: float

    def scale(self, factor: float) -> Slope:
        """Return it for another unit."""
        return Slope(self.value * factor, self.low * factor, self.high * factor)


def fit_slope(over: Floats, values: Floats) -> Slope | None:
    """Return the slope of a straight line through a series (n,), of which parts in a row are taken together.

    None where there are fewer samples than two for each part, or all at one place.
    """
    if len(values) < 2 * BLOCKS:
        return None
    x, y = (
        np.array([part.mean() for part in np.array_split(np.asarray(series, float), BLOCKS)])
        for series in (over, values)
    )
    x = x - x.mean()
    spread = float(x @ x)
    if spread == 0.0:
        return None
    value = float(x @ y) / spread
    rest = y - y.mean() - value * x
    std = math.sqrt(float(rest @ rest) / (BLOCKS - 2) / spread)
    wide = float(stats.t.ppf(0.975, BLOCKS - 2)) * std
    return Slope(value, value - wide, value + wide)
