"""Implements the homing methods 1 to 6, 17 to 22, 33, 34, 35 and 37 of CiA 402-2.

Positions are raw encoder positions, before any home offset. A switch is a bit of 0x60FD; the index pulse comes once per
revolution, at multiples of one revolution.
"""

import math
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

NEGATIVE, POSITIVE, HOME = 0, 1, 2  # bits of 0x60FD
_WATCHED = {-1: NEGATIVE, 1: POSITIVE}


class HomingState(Enum):
    IDLE = auto()
    RUNNING = auto()
    DONE = auto()
    ERROR = auto()


class HomingMove(NamedTuple):
    """One move of a search: direction, speed, and the bit and state that end it; no bit: the index pulse."""

    direction: int
    fast: bool
    bit: int | None
    state: bool = False


class _HomingEdge(NamedTuple):
    """The final edge of a method: moving in ``direction``, the switch changes to ``state``."""

    direction: int
    bit: int
    state: bool


# without index pulse; 1 to 6 are the same, followed by the pulse
_EDGES = {
    17: _HomingEdge(1, NEGATIVE, False),
    18: _HomingEdge(-1, POSITIVE, False),
    19: _HomingEdge(-1, HOME, False),
    20: _HomingEdge(1, HOME, True),
    21: _HomingEdge(1, HOME, False),
    22: _HomingEdge(-1, HOME, True),
}
_PULSES = {33: -1, 34: 1}
METHODS = frozenset({*_EDGES, *(method - 16 for method in _EDGES), *_PULSES, 35, 37})


def plan_moves(method: int, inputs: int) -> list[HomingMove]:
    """Return the moves of a method from a position with these inputs.

    >>> [leg.direction for leg in plan_moves(17, 0)], [leg.direction for leg in plan_moves(17, 1)]
    ([-1, 1], [1])
    """
    if method in _PULSES:
        return [HomingMove(_PULSES[method], False, None)]
    edge = _EDGES.get(method, _EDGES.get(method + 16))
    if edge is None:
        return []
    direction, bit, state = edge
    back, last = HomingMove(-direction, True, bit, not state), HomingMove(direction, False, bit, state)
    if bool(inputs >> bit & 1) != state:  # on the side from which the final edge is approached
        way = [last] if not state else [HomingMove(direction, True, bit, state), back._replace(fast=False), last]
    else:
        way = [back, last]
    return [*way, HomingMove(direction, False, None)] if method < 17 else way


@dataclass(frozen=True, slots=True)
class Switches:
    """Positions of the machine's switches, raw increments; None: not mounted. Home is active beyond its position."""

    negative: float | None = None
    positive: float | None = None
    home: float | None = None

    @property
    def has_switches(self) -> bool:
        return (self.negative, self.positive, self.home) != (None, None, None)

    def read_inputs(self, raw: float) -> int:
        """Return the bits of 0x60FD at a position."""
        bits = int(self.negative is not None and raw <= self.negative)
        bits |= (self.positive is not None and raw >= self.positive) << POSITIVE
        return bits | (self.home is not None and raw >= self.home) << HOME

    def has_switch(self, bit: int | None) -> bool:
        """Whether the switch of a bit is mounted; the index pulse always is."""
        return bit is None or (self.negative, self.positive, self.home)[bit] is not None


class HomingRun:
    """Runs one search at a time. ``home`` is the raw position found, ``leg`` the present move."""

    def __init__(self, switches: Switches, increments_per_rev: int) -> None:
        self.switches = switches
        self._per_rev = increments_per_rev
        self.reset_search()

    def reset_search(self) -> None:
        self.state = HomingState.IDLE
        self.home = 0.0
        self._legs: list[HomingMove] = []
        self._before = 0.0

    def start_search(self, method: int, raw: float, inputs: int) -> None:
        """Start a search at ``raw``."""
        self._legs = plan_moves(method, inputs)
        self._before = raw
        self.state = HomingState.RUNNING
        self.home = raw
        if method not in METHODS or not all(self.switches.has_switch(leg.bit) for leg in self._legs):
            self._fail_search()

    @property
    def current_move(self) -> HomingMove | None:
        """The present move; None: come to rest."""
        return self._legs[0] if self._legs else None

    def update_search(self, raw: float, inputs: int) -> None:
        """Update the search at position ``raw``; go on to the next move when the present one is complete."""
        leg = self.current_move
        if leg is None:
            return
        limit = _WATCHED[leg.direction]
        if leg.bit is None:
            found, place = self._find_index_pulse(leg.direction, raw)
        else:
            found, place = bool(inputs >> leg.bit & 1) == leg.state, raw
        self._before = raw
        if found:
            self.home = place
            self._legs.pop(0)
        elif limit != leg.bit and inputs >> limit & 1:
            self._fail_search()

    def finish_search(self) -> bool:
        """Complete the search at standstill; return True if it has just found home."""
        if self.state is not HomingState.RUNNING or self._legs:
            return False
        self.state = HomingState.DONE
        return True

    def _find_index_pulse(self, direction: int, raw: float) -> tuple[bool, float]:
        turn = self._per_rev
        first = math.floor(self._before / turn) + 1 if direction > 0 else math.ceil(self._before / turn) - 1
        place = float(first * turn)
        return (raw - place) * direction >= 0, place

    def _fail_search(self) -> None:
        self._legs = []
        self.state = HomingState.ERROR
