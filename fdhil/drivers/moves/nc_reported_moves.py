"""Detects G0 by the NC's own reports: the NC gives the kind of a move, the demand its edges. Pure.

The demand shows exactly when an axis moves back and forth; the NC's reports are as accurate in time as their source. So
a move in one direction has the kind that the NC reports within it, and where it reports two, they are divided at the
slowest sample of the demand between them. An NC that reports its own set-points is aligned by them, exact to a cycle;
any other by the clocks. A move without a report of the NC is UNKNOWN, and not used as a rapid.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.pdo_decoder import InputSamples
from fdhil.drivers.moves.demand_alignment import DemandAlignment
from fdhil.drivers.moves.motion_segments import MotionSegment, MotionSegmenter
from fdhil.records import AxisSamples, MoveEvent, MoveKind, NcMove, NcState, TickTimes

PATIENCE_S = 1.0  # beyond the NC's own silence, until a move without a report is UNKNOWN
AFTER_HOLD_S = 0.25  # of standstill before a rapid: one that continues sooner after a hold is not used
MOST_STATES = 20_000
MOVING = (MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC, MoveKind.UNKNOWN)
NEXT = 1.5  # ticks between states of neighbouring cycles


@dataclass(frozen=True, slots=True)
class TimedNcState:
    """A state of the NC, and the ticks between which it was valid."""

    low: float
    high: float
    state: NcState


class NcReportedMoves:
    """Classifies moves by samples, SYNC arrivals and NC states as RAPID, FEED, ARC, UNKNOWN and REST."""

    needs_input = False
    least_share = 0.0

    def __init__(self, axis: str, config: MachineConfig) -> None:
        increment_mm = 1 / config.axis[axis].scaling.increments_per_mm
        period_s = config.machine.sync_period_s
        self._axis, self._source = axis, config.g0.source
        self._after_hold = round(AFTER_HOLD_S / period_s)
        self._patience = round((config.nc_source.silence_s + PATIENCE_S) / period_s)
        self._clock = TickClock(period_s)
        self._alignment = DemandAlignment(axis, period_s, increment_mm)
        self._segmenter = MotionSegmenter(period_s, 2 * increment_mm)
        self._new: deque[NcState] = deque(maxlen=MOST_STATES)  # states without a tick yet
        self._states: deque[TimedNcState] = deque(maxlen=MOST_STATES)
        self._waiting: deque[MotionSegment] = deque()
        self._kind = MoveKind.REST

    def detect_moves(self, record: AxisSamples | InputSamples | TickTimes | NcState) -> list[MoveEvent]:
        """Take samples, SYNC arrivals, or a state of the NC; return the moves that can be classified by now."""
        if isinstance(record, TickTimes):
            self._clock.add_arrivals(record)
        elif isinstance(record, NcState):
            self._new.append(record)
        elif isinstance(record, AxisSamples) and record.axis == self._axis and record.tick.size:
            return list(self._process_samples(record))
        return []

    def _process_samples(self, samples: AxisSamples) -> Iterator[MoveEvent]:
        newest = self._segmenter.newest_tick
        if newest is not None and samples.tick[0] <= newest:  # the SYNC count restarted
            self._segmenter.reset_segments()
            self._alignment.reset_alignment()
            self._states.clear()
            self._waiting.clear()
        self._waiting += self._segmenter.split_demand(samples)
        self._place_states()
        self._alignment.add_bus_demand(samples.tick, samples.demand_mm)
        while self._waiting and self._is_known(self._waiting[0], int(samples.tick[-1])):
            yield from self._report_segment(self._waiting.popleft())

    def _place_states(self) -> None:
        while self._new:
            state = self._new[0]
            begin_ns, end_ns = state.stamp_ns - state.error_ns, state.stamp_ns + state.error_ns
            bounds = self._clock.bound_ticks(begin_ns, end_ns)
            is_last = not any(later.stamp_ns < begin_ns for later in self._new)  # otherwise its time stamp is wrong
            if bounds is None and is_last and not self._clock.is_past(begin_ns):
                return
            self._new.popleft()
            if bounds is not None:
                if self._is_restarted(state):
                    self._states.clear()
                self._states.append(TimedNcState(*bounds, state))
                self._alignment.add_nc_state(state, bounds[0])

    def _is_restarted(self, state: NcState) -> bool:
        last = self._states[-1].state.nc_tick if self._states else None
        return last is not None and state.nc_tick is not None and state.nc_tick < last

    def _locate_state(self, timed: TimedNcState) -> TimedNcState | None:
        """Locate a state by its set-points, else by the clocks; None while they are not aligned."""
        if not self._alignment.can_align(timed.state):
            return timed
        if self._alignment.offset is None or timed.state.nc_tick is None:
            return None
        tick = timed.state.nc_tick + self._alignment.offset
        return TimedNcState(tick, tick, timed.state)

    def _is_known(self, segment: MotionSegment, newest: int) -> bool:
        last = self._locate_state(self._states[-1]) if self._states else None
        return (last is not None and last.low > segment.end) or newest - segment.end > self._patience

    def _report_segment(self, segment: MotionSegment) -> Iterator[MoveEvent]:
        states = self._select_states(segment)
        pieces = list(self._classify_pieces(segment, states))
        for (begin, kind), (end, _) in pairwise([*pieces, (segment.end, MoveKind.REST)]):
            held = _has_feed_hold(_select_between(states, begin - self._after_hold, end))
            move = _summarise_move(_select_between(states, begin, end), begin, kind, held)
            if kind is not self._kind:
                yield MoveEvent(self._axis, kind, begin, self._source, move)
            self._kind = kind
        if not segment.goes_on:
            self._kind = MoveKind.REST
            yield MoveEvent(self._axis, MoveKind.REST, segment.end, self._source)

    def _select_states(self, segment: MotionSegment) -> list[TimedNcState]:
        """Return the states in a segment and the last before it, which was still valid; drop older ones."""
        placed = [found for found in map(self._locate_state, self._states) if found is not None]
        found = _select_between(placed, segment.begin - self._after_hold, segment.end)
        while found and self._states[0].state is not found[0].state:
            self._states.popleft()
        return found

    def _classify_pieces(
        self, segment: MotionSegment, states: Sequence[TimedNcState]
    ) -> Iterator[tuple[int, MoveKind]]:
        """Yield from which tick on a segment has which kind; at its first tick the axis does not move yet."""
        within = [each for each in states if each.low > segment.begin and each.high <= segment.end]
        sure = [each for each in within if each.state.motion in MOVING]
        if not sure:
            yield segment.begin, MoveKind.UNKNOWN
            return
        yield segment.begin, sure[0].state.motion
        for one, other in pairwise(sure):
            if one.state.motion is other.state.motion:
                continue
            if other.high - one.low <= NEXT:
                yield round(one.low), other.state.motion
            else:
                yield self._segmenter.find_slowest_tick(math.floor(one.low), math.ceil(other.high)), other.state.motion


def _select_between(states: Sequence[TimedNcState], begin: int, end: int) -> list[TimedNcState]:
    before = [each for each in states if each.high < begin]
    return [*before[-1:], *(each for each in states if each.high >= begin and each.low <= end)]


def _has_feed_hold(states: Sequence[TimedNcState]) -> bool | None:
    holds = [each.state.is_held for each in states if each.state.feed_hold is not None or each.state.is_held]
    return any(holds) if holds else None


def _summarise_move(timed: Sequence[TimedNcState], begin: int, kind: MoveKind, held: bool | None) -> NcMove:
    """Summarise the states of a move; its line is the first one reported while it ran."""
    states = [each.state for each in timed]
    own = [each.state for each in timed if each.low > begin and each.state.motion is kind]
    overrides = [override for state in states if (override := _select_override(state, kind)) is not None]
    return NcMove(
        line=next((state.line for state in own if state.line is not None), None),
        program=next((state.program for state in own if state.program), None),
        override=(min(overrides), max(overrides)) if overrides else None,
        held=held,
    )


def _select_override(state: NcState, kind: MoveKind) -> float | None:
    """Return the override that acts on a kind of move; no rapid is faster than at 100 %."""
    if kind is not MoveKind.RAPID:
        return state.feed_override
    if state.rapid_override is not None:
        return state.rapid_override
    return None if state.feed_override is None else min(1.0, state.feed_override)
