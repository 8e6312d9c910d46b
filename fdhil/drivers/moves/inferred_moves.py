"""Detects G0 by the demand alone: a move whose demand reaches the rapid speed is a rapid. Pure.

The kind of a move shows only once it is fast enough, or over; the event carries the tick at which it began.
"""

import numpy as np

from fdhil.config import MachineConfig
from fdhil.drivers.cia402.pdo_decoder import InputSamples
from fdhil.records import AxisSamples, MoveEvent, MoveKind, NcState, TickTimes

REST_SHARE = 0.002
REST_S = 0.010
DECISION_S = 2.0


class InferredMoves:
    """Classifies moves of an axis' samples as RAPID, FEED and REST."""

    needs_input = False
    least_share = 0.9  # above every feed, below an override of 100 %

    def __init__(self, axis: str, config: MachineConfig) -> None:
        settings = config.axis[axis]
        self._axis = axis
        self._period_s = config.machine.sync_period_s
        self._rapid_mm_s = self.least_share * settings.rapid_speed_mm_s
        # one increment per cycle is rounding of the set-point, not motion
        rounding = 2 / settings.scaling.increments_per_mm / self._period_s
        self._rest_mm_s = max(REST_SHARE * settings.rapid_speed_mm_s, rounding)
        self._last: tuple[int, float] | None = None
        self._start: int | None = None  # first tick of the present move
        self._kind: MoveKind | None = None
        self._still_since: int | None = None

    def detect_moves(self, record: AxisSamples | InputSamples | TickTimes | NcState) -> list[MoveEvent]:
        """Take a block of samples; return moves that began, ended or could be classified."""
        if not isinstance(record, AxisSamples) or record.axis != self._axis or record.tick.size == 0:
            return []
        if self._last is not None and record.tick[0] <= self._last[0]:
            self._last, self._start, self._kind, self._still_since = None, None, None, None
        tick, demand = record.tick, record.demand_mm
        if self._last is not None:
            tick = np.concatenate([[self._last[0]], tick])
            demand = np.concatenate([[self._last[1]], demand])
        self._last = int(tick[-1]), float(demand[-1])
        speed = np.abs(np.diff(demand)) / (np.diff(tick) * self._period_s)
        moving, fast = speed > self._rest_mm_s, speed >= self._rapid_mm_s
        edges = np.flatnonzero(np.diff(moving) | np.diff(fast)) + 1
        events: list[MoveEvent] = []
        for first, stop in zip([0, *edges], [*edges, speed.size], strict=True):
            if stop > first:
                events += self._process_piece(bool(moving[first]), bool(fast[first]), int(tick[first]), int(tick[stop]))
        return events

    def _process_piece(self, moving: bool, fast: bool, begin: int, end: int) -> list[MoveEvent]:
        if not moving:
            return self._process_rest(begin, end)
        self._still_since = None
        if self._start is None:
            self._start, self._kind = begin, None
        if fast and self._kind is not MoveKind.RAPID:
            return self._decide_kind(MoveKind.RAPID)
        if self._kind is None and (end - self._start) * self._period_s > DECISION_S:
            return self._decide_kind(MoveKind.FEED)
        return []

    def _process_rest(self, begin: int, end: int) -> list[MoveEvent]:
        if self._start is None:
            return []
        if self._still_since is None:
            self._still_since = begin
        if (end - self._still_since) * self._period_s < REST_S:
            return []
        events = self._decide_kind(MoveKind.FEED) if self._kind is None else []
        events.append(MoveEvent(self._axis, MoveKind.REST, self._still_since, "inferred"))
        self._start, self._kind, self._still_since = None, None, None
        return events

    def _decide_kind(self, kind: MoveKind) -> list[MoveEvent]:
        self._kind = kind
        return [MoveEvent(self._axis, kind, self._start or 0, "inferred")]
