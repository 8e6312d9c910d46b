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
from fdhil.drivers.cia402.drive import InputSamples
from fdhil.drivers.moves.alignment import DemandAlignment
from fdhil.drivers.moves.stretches import Stretch, Stretches
from fdhil.records import AxisSamples, MoveEvent, MoveKind, NcMove, NcState, TickTimes

PATIENCE_S = 1.0  # beyond the NC's own silence, until a move without a report is UNKNOWN
AFTER_HOLD_S = 0.25  # of standstill before a rapid: one that continues sooner after a hold is not used
MOST_STATES = 20_000
MOVING = (MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC, MoveKind.UNKNOWN)
NEXT = 1.5  # ticks between states of neighbouring cycles


@dataclass(frozen=True, slots=True)
class Said:
    """A state of the NC, and the ticks between which it was valid."""

    low: float
    high: float
    state: NcState


class ToldG0:
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
        self._moving = Stretches(period_s, 2 * increment_mm)
        self._new: deque[NcState] = deque(maxlen=MOST_STATES)  # states without a tick yet
        self._said: deque[Said] = deque(maxlen=MOST_STATES)
        self._waiting: deque[Stretch] = deque()
        self._kind = MoveKind.REST

    def feed(self, record: AxisSamples | InputSamples | TickTimes | NcState) -> list[MoveEvent]:
        """Take samples, SYNC arrivals, or a state of the NC; return the moves that can be classified by now."""
        if isinstance(record, TickTimes):
            self._clock.add(record)
        elif isinstance(record, NcState):
            self._new.append(record)
        elif isinstance(record, AxisSamples) and record.axis == self._axis and record.tick.size:
            return list(self._heard(record))
        return []

    def _heard(self, samples: AxisSamples) -> Iterator[MoveEvent]:
        newest = self._moving.newest
        if newest is not None and samples.tick[0] <= newest:  # the SYNC count restarted
            self._moving.clear()
            self._alignment.clear()
            self._said.clear()
            self._waiting.clear()
        self._waiting += self._moving.feed(samples)
        self._place_new()
        self._alignment.heard(samples.tick, samples.demand_mm)
        while self._waiting and self._is_known(self._waiting[0], int(samples.tick[-1])):
            yield from self._tell(self._waiting.popleft())

    def _place_new(self) -> None:
        while self._new:
            state = self._new[0]
            begin_ns, end_ns = state.stamp_ns - state.error_ns, state.stamp_ns + state.error_ns
            bounds = self._clock.bounds(begin_ns, end_ns)
            is_last = not any(later.stamp_ns < begin_ns for later in self._new)  # otherwise its time stamp is wrong
            if bounds is None and is_last and not self._clock.is_past(begin_ns):
                return
            self._new.popleft()
            if bounds is not None:
                if self._is_new_count(state):
                    self._said.clear()
                self._said.append(Said(*bounds, state))
                self._alignment.told(state, bounds[0])

    def _is_new_count(self, state: NcState) -> bool:
        last = self._said[-1].state.nc_tick if self._said else None
        return last is not None and state.nc_tick is not None and state.nc_tick < last

    def _where(self, timed: Said) -> Said | None:
        """Locate a state by its set-points, else by the clocks; None while they are not aligned."""
        if not self._alignment.possible(timed.state):
            return timed
        if self._alignment.offset is None or timed.state.nc_tick is None:
            return None
        tick = timed.state.nc_tick + self._alignment.offset
        return Said(tick, tick, timed.state)

    def _is_known(self, segment: Stretch, newest: int) -> bool:
        last = self._where(self._said[-1]) if self._said else None
        return (last is not None and last.low > segment.end) or newest - segment.end > self._patience

    def _tell(self, segment: Stretch) -> Iterator[MoveEvent]:
        states = self._about(segment)
        pieces = list(self._pieces(segment, states))
        for (begin, kind), (end, _) in pairwise([*pieces, (segment.end, MoveKind.REST)]):
            held = _held(_of_a_piece(states, begin - self._after_hold, end))
            move = _move(_of_a_piece(states, begin, end), begin, kind, held)
            if kind is not self._kind:
                yield MoveEvent(self._axis, kind, begin, self._source, move)
            self._kind = kind
        if not segment.goes_on:
            self._kind = MoveKind.REST
            yield MoveEvent(self._axis, MoveKind.REST, segment.end, self._source)

    def _about(self, segment: Stretch) -> list[Said]:
        """Return the states in a segment and the last before it, which was still valid; drop older ones."""
        placed = [found for found in map(self._where, self._said) if found is not None]
        found = _of_a_piece(placed, segment.begin - self._after_hold, segment.end)
        while found and self._said[0].state is not found[0].state:
            self._said.popleft()
        return found

    def _pieces(self, segment: Stretch, states: Sequence[Said]) -> Iterator[tuple[int, MoveKind]]:
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
                yield self._moving.slowest(math.floor(one.low), math.ceil(other.high)), other.state.motion


def _of_a_piece(states: Sequence[Said], begin: int, end: int) -> list[Said]:
    before = [each for each in states if each.high < begin]
    return [*before[-1:], *(each for each in states if each.high >= begin and each.low <= end)]


def _held(states: Sequence[Said]) -> bool | None:
    holds = [each.state.is_held for each in states if each.state.feed_hold is not None or each.state.is_held]
    return any(holds) if holds else None


def _move(timed: Sequence[Said], begin: int, kind: MoveKind, held: bool | None) -> NcMove:
    """Summarise the states of a move; its line is the first one reported while it ran."""
    states = [each.state for each in timed]
    own = [each.state for each in timed if each.low > begin and each.state.motion is kind]
    overrides = [override for state in states if (override := _override(state, kind)) is not None]
    return NcMove(
        line=next((state.line for state in own if state.line is not None), None),
        program=next((state.program for state in own if state.program), None),
        override=(min(overrides), max(overrides)) if overrides else None,
        held=held,
    )


def _override(state: NcState, kind: MoveKind) -> float | None:
    """Return the override that acts on a kind of move; no rapid is faster than at 100 %."""
    if kind is not MoveKind.RAPID:
        return state.feed_override
    if state.rapid_override is not None:
        return state.rapid_override
    return None if state.feed_override is None else min(1.0, state.feed_override)
