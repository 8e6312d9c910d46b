"""Records the sniffed demand of an air cut: r[k] of every axis, from the first motion to the last.

Pure: records in, a demand out. Lost samples stay gaps; nothing is interpolated.
"""

import math
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault
from fdhil.records import AxisSamples, Float, Int, Notice, Trajectory, freeze_array, freeze_integers

_SPOILING = ("DemandMismatch", "BusDown", "SyncCollision", "RxOverflow", "ForeignProducer")


@dataclass(frozen=True, slots=True)
class Gap:
    """Lost samples [first, stop) of an axis' demand."""

    axis: str
    first: int
    stop: int


@dataclass(frozen=True, slots=True)
class RecordedDemand:
    """A demand with NaN in lost samples, its gaps, and other reasons not to trust it."""

    reference: Trajectory
    gaps: tuple[Gap, ...]
    doubts: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether it has no gap and no reason for doubt."""
        return not self.gaps and not self.doubts


@dataclass(slots=True)
class _AxisDemand:
    ticks: list[Int]
    demands: list[Float]
    newest: int = -1
    moved_first: int | None = None
    moved_last: int | None = None

    def add_samples(self, samples: AxisSamples, anything_moved: bool) -> None:
        if not samples.tick.size:
            return
        demand = samples.demand_mm
        before = self.demands[-1][-1] if self.demands else demand[0]
        steps = np.flatnonzero(np.diff(demand, prepend=before))
        if steps.size:
            self.moved_first = int(samples.tick[steps[0]]) if self.moved_first is None else self.moved_first
            self.moved_last = int(samples.tick[steps[-1]])
        if not anything_moved and not steps.size and len(self.ticks) > 1:
            del self.ticks[0], self.demands[0]
        self.ticks.append(samples.tick)
        self.demands.append(demand)
        self.newest = int(samples.tick[-1])


class DemandRecorder:
    """Collects the records of a machine; ``is_done`` once all axes have rested ``rest_s`` after a motion.

    ConfigError when the axes are on several buses, whose SYNC cycles have no common count.
    """

    def __init__(self, config: MachineConfig, rest_s: float) -> None:
        buses = list(dict.fromkeys(axis.drive.bus for axis in config.axis.values()))
        if len(buses) > 1:
            what = f"the axes are on {', '.join(buses)}, whose SYNC cycles have no common count"
            raise ConfigError(
                config.machine.name,
                [ConfigFault("axis", what, "record each bus with a separate configuration of its axes")],
            )
        self._dt_s, self._mm_per_degree = config.machine.sync_period_s, config.mm_per_degree
        self._rest_rows = math.ceil(rest_s / self._dt_s)
        self._end_rows = math.ceil(config.nc.end_rest_s / self._dt_s)
        self._axes = {name: _AxisDemand([], []) for name in config.axis}
        self._doubts: dict[str, str] = {}

    def add_record(self, record: object) -> None:
        """Add a record; only samples and warnings matter here."""
        if isinstance(record, AxisSamples):
            self._axes[record.axis].add_samples(record, self.has_moved)
        elif isinstance(record, Notice) and record.code in _SPOILING and record.severity != "info":
            self._doubts[record.code] = record.text

    @property
    def has_all_axes(self) -> bool:
        """Whether the demand of every axis has been received."""
        return all(axis.newest >= 0 for axis in self._axes.values())

    @property
    def has_moved(self) -> bool:
        return any(axis.moved_first is not None for axis in self._axes.values())

    @property
    def is_done(self) -> bool:
        """Whether a motion has ended for the requested rest; a lost bus ends it too."""
        last = [axis.moved_last for axis in self._axes.values() if axis.moved_last is not None]
        newest = min(axis.newest for axis in self._axes.values())
        return "BusDown" in self._doubts or (bool(last) and newest >= max(last) + self._rest_rows)

    def build_demand(self) -> RecordedDemand | None:
        """Return the demand from the sample before the first motion to the rest after the last, if any."""
        firsts = [axis.moved_first for axis in self._axes.values() if axis.moved_first is not None]
        lasts = [axis.moved_last for axis in self._axes.values() if axis.moved_last is not None]
        if not firsts:
            return None
        first = min(firsts) - 1
        stop = 1 + min(max(lasts) + self._end_rows, max(axis.newest for axis in self._axes.values()))
        position, gaps = {}, []
        for name, axis in self._axes.items():
            rows = np.full(stop - first, np.nan)
            tick = np.concatenate(axis.ticks) if axis.ticks else np.empty(0, np.int64)
            inside = (tick >= first) & (tick < stop)
            rows[tick[inside] - first] = (np.concatenate(axis.demands) if axis.ticks else np.empty(0))[inside]
            position[name] = freeze_array(rows)
            gaps += [Gap(name, int(run[0]), int(run[-1]) + 1) for run in _split_runs(np.flatnonzero(np.isnan(rows)))]
        rapid = np.zeros(stop - first, np.bool_)
        rapid.setflags(write=False)
        time_s = freeze_array(np.arange(stop - first) * self._dt_s)
        line = freeze_integers(np.zeros(stop - first))
        reference = Trajectory(self._dt_s, time_s, position, rapid, line, mm_per_degree=self._mm_per_degree)
        return RecordedDemand(reference, tuple(gaps), tuple(self._doubts.values()))


def _split_runs(rows: Int) -> list[Int]:
    return [run for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if run.size]
