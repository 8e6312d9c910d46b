"""State of the control flow: positions, labels, calls, and the turns of a loop, which reveal an endless one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from fdhil.program.program_source import SourcePlace

_FIRST = 64  # no cost for short loops
_LOOKED_AT = 8  # turns compared with each stored state


@dataclass(slots=True)
class LoopTurns:
    """Turns of one loop. A program depends only on its own state, so equal states have equal futures.

    States are stored at 64, 128, 256 and so on turns, and compared with those of the eight following turns.
    """

    count: int = 0
    kept: object = None

    def count_turn(self, state: Callable[[], object]) -> bool:
        """Count a turn; return True if the state equals the stored one. ``state`` returns a comparable copy."""
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

    def reset_turns(self) -> None:
        """Reset the turns: the loop has ended and may begin again."""
        self.count, self.kept = 0, None


@dataclass(slots=True)
class FlowLabel:
    """State of a label in this call: what opened it where, and its progress."""

    kind: str
    line: int
    place: SourcePlace
    done: bool = False
    left: float = 0.0
    turns: LoopTurns = field(default_factory=LoopTurns)


@dataclass(slots=True)
class CallFrame:
    """One call: where to return to, the labels of the subroutine, and whether its lines were executed before.

    ``repeated`` applies to the call as a whole, ``turning`` are the loops beyond their first turn.
    """

    name: str
    back: SourcePlace | None = None
    fanuc: bool = False
    again: int = 0
    entry: SourcePlace | None = None
    repeated: bool = False
    labels: dict[str, FlowLabel] = field(default_factory=dict)
    turning: set[str] = field(default_factory=set)


@dataclass(slots=True)
class SkipTarget:
    """Skipping of lines until ``label`` with one of ``keywords``; that line is then executed or not."""

    label: str
    keywords: tuple[str, ...]
    line: int
    execute: bool = False
