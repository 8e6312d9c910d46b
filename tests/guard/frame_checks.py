"""Checks the offset frames to one drive by the bus and the drive's offset, independent of the guard's state."""

from __future__ import annotations

from collections import deque

from fdhil.guard.offset_limits import OffsetLimits

CEILING = 819
"""250 um of the bench's axis in increments."""


class Wire:
    """``ours`` returns what is wrong with a frame of the guard, None when nothing is.

    A frame may continue the last one on the bus, whatever sent it, or the drive's offset: anything else is a step. A
    cycle without our frame stops the offset.
    """

    def __init__(self, limits: OffsetLimits, held: int) -> None:
        self._limits = limits
        self._last = self._before = held
        self._rate = 0
        self._moves: deque[int] = deque([0], maxlen=limits.window)
        self._travelled = 0

    def foreign(self, value: int) -> None:
        self._last = self._before = value
        self._rate = 0

    def lost(self) -> None:
        self._last, self._rate = self._before, 0

    def stood(self, before: int) -> None:
        self._before, self._rate = before, self._last - before

    def nothing(self) -> None:
        self._rate = 0
        self._travel(0)

    def _travel(self, move: int) -> None:
        if len(self._moves) == self._moves.maxlen:
            self._travelled -= self._moves[0]
        self._moves.append(move)
        self._travelled += move

    def ours(self, value: object, held: int) -> str | None:
        if type(value) is not int:
            return f"{value!r} is no integer"
        wrong = [self._judge(value, self._last, self._rate)]
        if wrong[0] is not None and held != self._last:
            wrong.append(self._judge(value, held, 0))
        start = self._last if None in wrong[:1] else held
        self._travel(abs(value - start))
        self._before, self._last, self._rate = start, value, value - start
        if self._travelled > self._limits.variation + 2 * CEILING:
            return f"travels {self._travelled} in a second"
        return None if None in wrong else "; ".join(map(str, wrong))

    def _judge(self, value: int, before: int, rate: int) -> str | None:
        limits, move = self._limits, value - before
        if abs(value) > CEILING or abs(value) > max(limits.offset, abs(before)):
            return f"{before} -> {value}: beyond the largest offset"
        if abs(move) > limits.hard_rate:
            return f"{before} -> {value}: a step"
        if abs(move - rate) > limits.hard_acceleration:
            return f"{before} + {rate} -> {value}: accelerates too much"
        return None
