"""Contracts of :func:`stopping` and :func:`approach`, used instead of their code, whose products are slow in z3.

``test_limits`` proves each contract from the code itself.
"""

from __future__ import annotations

from itertools import count
from typing import NamedTuple

from tests.proof.symbolic import Claim, Integer, assume, choose, integers


class _Stopping(NamedTuple):
    rate: Integer
    acceleration: Integer
    way: Integer


class _Approach(NamedTuple):
    distance: Integer
    acceleration: Integer
    rate: Integer


class Contracts:
    """Answers each call by an unknown integer and states everything guaranteed about it and earlier ones."""

    def __init__(self) -> None:
        self._stopping: list[_Stopping] = []
        self._approach: list[_Approach] = []
        self._number = count()

    def _unknown(self) -> Integer:
        (made,) = integers(f"contract_{next(self._number)}")
        return made

    def stopping(self, rate: Integer, acceleration: Integer) -> Integer:
        made = _Stopping(rate, acceleration, self._unknown())
        assume(made.way >= 0, (rate <= acceleration).implies(made.way == 0))
        for other in self._stopping:
            assume(_travels_as_far(made, other), _travels_as_far(other, made))
        self._stopping.append(made)
        for approach in self._approach:
            assume(_is_fastest(approach, made))
        return made.way

    def approach(self, distance: Integer, acceleration: Integer) -> Integer:
        made = _Approach(distance, acceleration, self._unknown())
        self.stopping(choose(distance <= acceleration, distance, acceleration), acceleration)  # a rate that does stop
        assume(made.rate >= 0, made.rate + self.stopping(made.rate, acceleration) <= distance)
        for stopping in self._stopping:
            assume(_is_fastest(made, stopping))
        self._approach.append(made)
        return made.rate

    def one_step(self, rate: Integer, acceleration: Integer) -> Integer:
        """Return the distance travelled from ``rate``; the rest after one cycle of braking is stated, too."""
        way = self.stopping(rate, acceleration)
        left = rate - acceleration
        assume((rate >= acceleration).implies(way == left + self.stopping(left, acceleration)))
        return way


def _travels_as_far(one: _Stopping, other: _Stopping) -> Claim:
    """State: faster or braked less, it travels at least as far."""
    faster = (one.rate >= other.rate) & (other.rate >= 0) & (one.acceleration <= other.acceleration)
    return faster.implies(one.way >= other.way)


def _is_fastest(approach: _Approach, stopping: _Stopping) -> Claim:
    """State: no larger rate than the approach rate still stops within the distance."""
    stops = (stopping.rate >= 0) & (stopping.acceleration == approach.acceleration)
    return (stops & (stopping.rate + stopping.way <= approach.distance)).implies(stopping.rate <= approach.rate)
