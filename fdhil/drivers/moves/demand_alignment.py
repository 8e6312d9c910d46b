"""Aligns the NC's own set-points with those on the bus: determines the difference of the cycle counts. Pure.

The NC reports a set-point now and then with its own cycle count; on the bus it comes some cycles later, rounded to the
drive's increments, from another zero. A group of set-points of a moving axis fits the bus in one position only; clocks
only determine where the search begins.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from fdhil.records import Float, Int, NcState

GROUP = 16  # set-points that are aligned together
LONGEST_GROUP_S = 2.0
LEAD_S, LAG_S = 0.2, 6.0  # limits of the apparent lead and lag of the bus
KEPT_S = LAG_S + 2 * LONGEST_GROUP_S
MOST_GROUPS = 50
ROUNDING = 1.2  # increments between two rounded set-points
SAME_PERIOD = 1e-3


@dataclass(slots=True)
class _SetpointGroup:
    cycle: list[int] = field(default_factory=list)
    demand_mm: list[float] = field(default_factory=list)
    next_offset: int = 0
    last_offset: int = 0
    found: int | None = None


class DemandAlignment:
    """The offset of one axis: bus tick less NC cycle; None while it is unknown or no longer valid."""

    def __init__(self, axis: str, period_s: float, increment_mm: float) -> None:
        self._axis = axis
        self._period_s = period_s
        self._tolerance_mm = ROUNDING * increment_mm
        self.reset_alignment()

    def reset_alignment(self) -> None:
        """Start again after a count restarted."""
        self.offset: int | None = None
        self._first_tick = 0
        self._bus: Float = np.empty(0)
        self._open = _SetpointGroup()
        self._waiting: deque[_SetpointGroup] = deque(maxlen=MOST_GROUPS)
        self._before: tuple[int, float] | None = None

    def add_nc_state(self, state: NcState, tick: float) -> None:
        """Add a state of the NC; by the clocks it was near ``tick``."""
        if state.demand_mm is None or state.nc_tick is None or not self.can_align(state):
            return
        cycle, place = state.nc_tick, state.demand_mm.get(self._axis)
        before, self._before = self._before, None if place is None else (cycle, place)
        if place is None or before is None:
            return
        if cycle <= before[0]:  # the NC was restarted
            self.offset, self._open = None, _SetpointGroup()
            self._waiting.clear()
            return
        group = self._open
        if group.cycle and (cycle - group.cycle[0]) * self._period_s > LONGEST_GROUP_S:
            group = self._open = _SetpointGroup()
        if abs(place - before[1]) > self._tolerance_mm:
            group.cycle.append(cycle)
            group.demand_mm.append(place)
        if len(group.cycle) == GROUP:
            expected = round(tick) - cycle
            group.next_offset = expected - round(LEAD_S / self._period_s)
            group.last_offset = expected + round(LAG_S / self._period_s)
            self._waiting.append(group)
            self._open = _SetpointGroup()

    def can_align(self, state: NcState) -> bool:
        """Return whether the NC reports set-points that can be aligned: one for each SYNC."""
        period_s = state.nc_period_s
        return (
            state.demand_mm is not None
            and state.nc_tick is not None
            and period_s is not None
            and abs(period_s / self._period_s - 1) < SAME_PERIOD
        )

    def add_bus_demand(self, tick: Int, demand_mm: Float) -> None:
        """Add a block of the bus, (n,) each."""
        if not tick.size:
            return
        if not self._bus.size:
            self._first_tick = int(tick[0])
        rows = np.full(int(tick[-1]) + 1 - self._first_tick, np.nan)
        rows[: self._bus.size] = self._bus
        rows[tick - self._first_tick] = demand_mm
        drop = max(0, rows.size - round(KEPT_S / self._period_s))
        self._bus, self._first_tick = rows[drop:], self._first_tick + drop
        for group in list(self._waiting):
            self._try_offsets(group)

    def _try_offsets(self, group: _SetpointGroup) -> None:
        cycle, demand = np.array(group.cycle), np.array(group.demand_mm)
        newest = self._first_tick + self._bus.size - 1 - group.cycle[-1]
        if self.offset is not None:
            if newest < self.offset:
                return
            if self._match_offsets(cycle, demand, np.array([self.offset]))[0]:
                self._waiting.remove(group)
                return
            self.offset = None
        begin = max(group.next_offset, self._first_tick - group.cycle[0])
        end = min(group.last_offset, newest) + 1
        if end > begin:
            fitting = begin + np.flatnonzero(self._match_offsets(cycle, demand, np.arange(begin, end)))
            group.next_offset = end
            self._decide_offset(group, fitting, end)
        if group in self._waiting and group.next_offset > group.last_offset:
            self._waiting.remove(group)

    def _decide_offset(self, group: _SetpointGroup, fitting: Int, end: int) -> None:
        """Accept an offset whose neighbours do not fit; at constant speed all of them do, and none is accepted."""
        first = group.found if group.found is not None else int(fitting[0]) if fitting.size else None
        if first is None:
            return
        if first + 1 in fitting:
            self._waiting.remove(group)
        elif first + 1 < end:
            self.offset = first
            self._waiting.remove(group)
        else:
            group.found = first

    def _match_offsets(self, cycle: Int, demand_mm: Float, offsets: Int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return for each offset (n,) whether bus and NC agree, apart from a constant."""
        rows = offsets[:, None] + cycle[None, :] - self._first_tick
        inside = (rows[:, 0] >= 0) & (rows[:, -1] < self._bus.size)
        apart = self._bus[np.clip(rows, 0, self._bus.size - 1)] - demand_mm
        spread = np.ptp(apart, axis=1)
        with np.errstate(invalid="ignore"):
            fits: np.ndarray[tuple[int], np.dtype[np.bool_]] = inside & (spread <= self._tolerance_mm)
        return fits
