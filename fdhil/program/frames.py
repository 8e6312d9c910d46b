"""The flow of a program keeps places, labels, calls, and the turns of a loop, which show when it never ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from fdhil.program.source import Place

_FIRST = 64  # short loops pay nothing
_LOOKED_AT = 8  # so many turns are compared with every state that is kept


@dataclass(slots=True)
class Turns:
    """The turns of one loop. A program reads nothing but itself, so equal states have equal futures.

    States are kept at 64, 128, 256 and so on turns, and compared with those of the eight turns that follow.
    """

    count: int = 0
    kept: object = None

    def one_more(self, state: Callable[[], object]) -> bool:
        """Count a turn; True when the state is one that was kept. ``state`` returns a copy that can be compared."""
        self.count += 1
        if self.count < _FIRST:
            return False
        since = self.count - (1 << self.count.bit_length() - 1)
        if since > _LOOKED_AT:
            self.kept = None
        elif since == 0:
            self.kept = state()
        else:
            return state() == self.kept
        return False

    def end(self) -> None:
        """Forget the turns: the loop has ended and may begin anew."""
        self.count, self.kept = 0, None


@dataclass(slots=True)
class Label:
    """What is known of a label in this call: what opened it where, and how far it is."""

    kind: str
    line: int
    place: Place
    done: bool = False
    left: float = 0.0
    turns: Turns = field(default_factory=Turns)


@dataclass(slots=True)
class Frame:
    """One call: where to go back to, the labels of the subroutine, and whether its lines were executed before.

    ``repeated`` tells that of the call as a whole, ``turning`` are the loops that are beyond their first turn.
    """

    name: str
    back: Place | None = None
    fanuc: bool = False
    again: int = 0
    entry: Place | None = None
    repeated: bool = False
    labels: dict[str, Label] = field(default_factory=dict)
    turning: set[str] = field(default_factory=set)


@dataclass(slots=True)
class Skip:
    """Reading over lines until ``label`` comes with one of ``keywords``; then that line is executed or not."""

    label: str
    keywords: tuple[str, ...]
    line: int
    execute: bool = False
