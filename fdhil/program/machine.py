"""The interpreter's machine: converts moves in active co-ordinates to motions in machine millimetres.

With cutter compensation on, a move is ordered only when the next one is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fdhil.errors import GcodeBudget
from fdhil.program.budget import Budget
from fdhil.program.compensation import Compensation, Piece, Waiting
from fdhil.program.modal import AXES, Modal
from fdhil.program.motions import PLANE_AXES, Arc, Corner, Dwell, Feed, Motion, Point, Probe, Rapid, Turned
from fdhil.program.targets import feed_mm_min, straight_length
from fdhil.program.words import Block

_TINY_MM = 1e-9


@dataclass(slots=True)
class Machine:
    """The modal state, and the motions ordered by the current block so far (``out``)."""

    budget: Budget
    modal: Modal = field(default_factory=Modal)
    out: list[Motion] = field(default_factory=list)
    compensation: Compensation | None = None
    others: list[float] = field(default_factory=lambda: [0.0] * 6)  # A B C U V W of the last motion, machine
    just_left: bool = False  # compensation has just ended, so the next motion must be straight

    def rapid_to(self, block: Block, target: list[float]) -> None:
        """Order a rapid to a position in active co-ordinates."""
        self.line_to(block, target, None)

    def rapid_beside(self, block: Block, target: list[float]) -> None:
        """Order a rapid without cutter compensation, which the next move enters again."""
        compensation = self.compensation
        if compensation is not None:
            self._give(compensation.flush())
            compensation.entered, self.compensation = False, None
        self.rapid_to(block, target)
        self.compensation = compensation

    def feed_to(self, block: Block, target: list[float]) -> None:
        """Order a straight feed to a position in active co-ordinates, at the feed in force."""
        self.line_to(block, target, feed_mm_min(self.modal, block, straight_length(self.modal.position, target)))

    def line_to(self, block: Block, target: list[float], feed: float | None) -> None:
        """Order a straight line to a position in active co-ordinates at ``feed`` mm/min, a rapid if None."""
        start = self.modal.position
        self.modal.position = target
        self.just_left = False
        if self.compensation is None:
            self._line(block, target, feed)
            return
        self._checked(block, target)
        a, b = self._flat(start), self._flat(target)
        if abs(b - a) < _TINY_MM and self.compensation.entered:
            self.compensation.wait(Waiting(block, None, target, feed))
            return
        self._give(self.compensation.line(block, a, b, target, feed))

    def dwell(self, block: Block, seconds: float) -> None:
        """Order a dwell; ``seconds`` is P, in the dialect's unit."""
        dwell = Dwell(block.line, self.budget.dialect.dwell_s(seconds, "p" in block.pointless))
        if self.compensation is None or not self.compensation.wait(Waiting(block, dwell)):
            self._order(block, dwell)

    def arc_to(self, block: Block, target: list[float], centre: complex, turns: int, feed: float, angle: float) -> None:
        """Order an arc to ``target`` about ``centre`` (first + j second axis), both in active co-ordinates."""
        if self.just_left:
            raise block.fault(self.modal.code, "the move after G40 must be straight")
        if self.compensation is None:
            self._arc(block, target, centre, turns, feed)
            return
        start, corner = self._flat(self.modal.position), self._flat(target)
        self.modal.position = target
        self._checked(block, target)
        self._give(self.compensation.arc(block, start, corner, centre, turns, target, feed, angle))

    def settle(self) -> None:
        """Order the piece that waits for the next corner, since the machine stops here (M0, M1, M60)."""
        if self.compensation is not None:
            self._give(self.compensation.settle())

    def end_compensation(self) -> None:
        """Switch cutter compensation off (G40, program end) and order what waits."""
        if self.compensation is not None:
            self._give(self.compensation.flush())
            self.just_left = self.compensation.entered
            self.compensation = None

    def _flat(self, position: list[float]) -> complex:
        first, second, _ = PLANE_AXES[self.modal.plane_name]
        return complex(position[first], position[second])

    def _lifted(self, place: complex, whole: list[float]) -> list[float]:
        first, second, _ = PLANE_AXES[self.modal.plane_name]
        lifted = list(whole)
        lifted[first], lifted[second] = place.real, place.imag
        return lifted

    def _give(self, pieces: list[Piece]) -> None:
        tip = self.compensation.tip if self.compensation is not None else 0.0
        for piece in pieces:
            end = self._lifted(piece.end + tip, piece.whole)
            if piece.given:
                pass
            elif piece.centre is not None and piece.feed is not None:
                self._arc(piece.block, end, piece.centre + tip, piece.turns, piece.feed)
            else:
                self._line(piece.block, end, piece.feed)
            for waiting in piece.waiting:
                if waiting.dwell is not None:
                    self._order(waiting.block, waiting.dwell)
                else:
                    self._line(waiting.block, self._lifted(piece.end + tip, waiting.whole), waiting.feed)

    def _line(self, block: Block, target: list[float], feed: float | None) -> None:
        end, corner, rotary = self._checked(block, target), self.modal.corner, self._turned(block, target)
        motion = Rapid(block.line, end, corner, rotary) if feed is None else Feed(block.line, end, feed, corner, rotary)
        self._order(block, motion)

    def _arc(self, block: Block, target: list[float], centre: complex, turns: int, feed: float) -> None:
        about: list[float | None] = list(self.modal.machine(self._lifted(centre, target)))
        about[PLANE_AXES[self.modal.plane_name][2]] = None
        if self.compensation is None:
            self.modal.position = target
        end, plane = self._checked(block, target), self.modal.plane_name
        corner, rotary = self.modal.corner, self._turned(block, target)
        self._order(block, Arc(block.line, end, (about[0], about[1], about[2]), turns, plane, feed, corner, rotary))

    def _order(self, block: Block, motion: Motion) -> None:
        if len(self.out) >= self.budget.max_motions_per_block:
            most = self.budget.max_motions_per_block
            raise GcodeBudget(block.line, "", f"the block orders more than {most} motions; split it")
        self.out.append(motion)

    def _checked(self, block: Block, position: list[float]) -> Point:
        end = self.modal.machine(position)
        limit = self.budget.max_coordinate_mm
        for letter, value in zip("xyz", end, strict=True):
            if not abs(value) <= limit:
                raise block.fault(letter, f"leads to {value:g} mm; no machine reaches beyond {limit:g} mm")
        return end

    def _turned(self, block: Block, position: list[float]) -> tuple[Turned, ...]:
        before, self.others = self.others, self.modal.others(position)
        moved = zip(AXES[3:], before, self.others, strict=True)
        return tuple(
            Turned(letter.upper(), start, end)
            for letter, start, end in moved
            if letter in block.words or abs(end - start) > _TINY_MM
        )

    def probe_to(self, block: Block, target: list[float], feed: float) -> None:
        """Order a probe move to a position in active co-ordinates at ``feed`` mm/min."""
        self.modal.position = target
        end, stop = self._checked(block, target), Corner("exact_stop")
        self._order(block, Probe(block.line, end, feed, stop, self._turned(block, target)))

    def stand_at(self, block: Block, position: list[float]) -> None:
        """Set the position without ordering a motion (the operator moves)."""
        self.modal.position = position
        self._checked(block, position)
