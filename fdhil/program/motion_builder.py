"""The interpreter's machine: converts moves in active co-ordinates to motions in machine millimetres.

With cutter compensation on, a move is ordered only when the next one is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fdhil.errors import GcodeBudget
from fdhil.program.budget import Budget
from fdhil.program.cutter_compensation import CompensatedPiece, CutterCompensation, DeferredAction
from fdhil.program.modal_state import AXES, ModalState
from fdhil.program.motions import PLANE_AXES, Arc, AxisMove, Corner, Dwell, Feed, Motion, Point, Probe, Rapid
from fdhil.program.targets import compute_feed_mm_min, measure_straight_length
from fdhil.program.words import Block

_TINY_MM = 1e-9


@dataclass(slots=True)
class MotionBuilder:
    """The modal state, and the motions ordered by the current block so far (``out``)."""

    budget: Budget
    modal: ModalState = field(default_factory=ModalState)
    out: list[Motion] = field(default_factory=list)
    compensation: CutterCompensation | None = None
    others: list[float] = field(default_factory=lambda: [0.0] * 6)  # A B C U V W of the last motion, machine
    just_left: bool = False  # compensation has just ended, so the next motion must be straight

    def move_rapid_to(self, block: Block, target: list[float]) -> None:
        """Order a rapid to a position in active co-ordinates."""
        self.move_line_to(block, target, None)

    def move_rapid_without_compensation(self, block: Block, target: list[float]) -> None:
        """Order a rapid without cutter compensation, which the next move enters again."""
        compensation = self.compensation
        if compensation is not None:
            self._order_pieces(compensation.flush_pending())
            compensation.entered, self.compensation = False, None
        self.move_rapid_to(block, target)
        self.compensation = compensation

    def feed_to(self, block: Block, target: list[float]) -> None:
        """Order a straight feed to a position in active co-ordinates, at the feed in force."""
        self.move_line_to(
            block, target, compute_feed_mm_min(self.modal, block, measure_straight_length(self.modal.position, target))
        )

    def move_line_to(self, block: Block, target: list[float], feed: float | None) -> None:
        """Order a straight line to a position in active co-ordinates at ``feed`` mm/min, a rapid if None."""
        start = self.modal.position
        self.modal.position = target
        self.just_left = False
        if self.compensation is None:
            self._order_line(block, target, feed)
            return
        self._convert_to_machine_mm(block, target)
        a, b = self._project_to_plane(start), self._project_to_plane(target)
        if abs(b - a) < _TINY_MM and self.compensation.entered:
            self.compensation.defer_action(DeferredAction(block, None, target, feed))
            return
        self._order_pieces(self.compensation.add_line(block, a, b, target, feed))

    def add_dwell(self, block: Block, seconds: float) -> None:
        """Order a dwell; ``seconds`` is P, in the dialect's unit."""
        dwell = Dwell(block.line, self.budget.dialect.convert_dwell_s(seconds, "p" in block.pointless))
        if self.compensation is None or not self.compensation.defer_action(DeferredAction(block, dwell)):
            self._append_motion(block, dwell)

    def move_arc_to(
        self, block: Block, target: list[float], centre: complex, turns: int, feed: float, angle: float
    ) -> None:
        """Order an arc to ``target`` about ``centre`` (first + j second axis), both in active co-ordinates."""
        if self.just_left:
            raise block.build_error(self.modal.code, "the move after G40 must be straight")
        if self.compensation is None:
            self._order_arc(block, target, centre, turns, feed)
            return
        start, corner = self._project_to_plane(self.modal.position), self._project_to_plane(target)
        self.modal.position = target
        self._convert_to_machine_mm(block, target)
        self._order_pieces(self.compensation.add_arc(block, start, corner, centre, turns, target, feed, angle))

    def settle_compensation(self) -> None:
        """Order the piece that waits for the next corner, since the machine stops here (M0, M1, M60)."""
        if self.compensation is not None:
            self._order_pieces(self.compensation.settle_pending())

    def end_compensation(self) -> None:
        """Switch cutter compensation off (G40, program end) and order what waits."""
        if self.compensation is not None:
            self._order_pieces(self.compensation.flush_pending())
            self.just_left = self.compensation.entered
            self.compensation = None

    def _project_to_plane(self, position: list[float]) -> complex:
        first, second, _ = PLANE_AXES[self.modal.plane_name]
        return complex(position[first], position[second])

    def _lift_from_plane(self, place: complex, whole: list[float]) -> list[float]:
        first, second, _ = PLANE_AXES[self.modal.plane_name]
        lifted = list(whole)
        lifted[first], lifted[second] = place.real, place.imag
        return lifted

    def _order_pieces(self, pieces: list[CompensatedPiece]) -> None:
        tip = self.compensation.tip if self.compensation is not None else 0.0
        for piece in pieces:
            end = self._lift_from_plane(piece.end + tip, piece.whole)
            if piece.given:
                pass
            elif piece.centre is not None and piece.feed is not None:
                self._order_arc(piece.block, end, piece.centre + tip, piece.turns, piece.feed)
            else:
                self._order_line(piece.block, end, piece.feed)
            for waiting in piece.waiting:
                if waiting.dwell is not None:
                    self._append_motion(waiting.block, waiting.dwell)
                else:
                    self._order_line(waiting.block, self._lift_from_plane(piece.end + tip, waiting.whole), waiting.feed)

    def _order_line(self, block: Block, target: list[float], feed: float | None) -> None:
        end, corner, rotary = (
            self._convert_to_machine_mm(block, target),
            self.modal.corner,
            self._find_turned_axes(block, target),
        )
        motion = Rapid(block.line, end, corner, rotary) if feed is None else Feed(block.line, end, feed, corner, rotary)
        self._append_motion(block, motion)

    def _order_arc(self, block: Block, target: list[float], centre: complex, turns: int, feed: float) -> None:
        about: list[float | None] = list(self.modal.convert_to_machine(self._lift_from_plane(centre, target)))
        about[PLANE_AXES[self.modal.plane_name][2]] = None
        if self.compensation is None:
            self.modal.position = target
        end, plane = self._convert_to_machine_mm(block, target), self.modal.plane_name
        corner, rotary = self.modal.corner, self._find_turned_axes(block, target)
        self._append_motion(
            block, Arc(block.line, end, (about[0], about[1], about[2]), turns, plane, feed, corner, rotary)
        )

    def _append_motion(self, block: Block, motion: Motion) -> None:
        if len(self.out) >= self.budget.max_motions_per_block:
            most = self.budget.max_motions_per_block
            raise GcodeBudget(block.line, "", f"the block orders more than {most} motions; split it")
        self.out.append(motion)

    def _convert_to_machine_mm(self, block: Block, position: list[float]) -> Point:
        end = self.modal.convert_to_machine(position)
        limit = self.budget.max_coordinate_mm
        for letter, value in zip("xyz", end, strict=True):
            if not abs(value) <= limit:
                raise block.build_error(letter, f"leads to {value:g} mm; no machine reaches beyond {limit:g} mm")
        return end

    def _find_turned_axes(self, block: Block, position: list[float]) -> tuple[AxisMove, ...]:
        before, self.others = self.others, self.modal.convert_others_to_machine(position)
        moved = zip(AXES[3:], before, self.others, strict=True)
        return tuple(
            AxisMove(letter.upper(), start, end)
            for letter, start, end in moved
            if letter in block.words or abs(end - start) > _TINY_MM
        )

    def probe_to(self, block: Block, target: list[float], feed: float) -> None:
        """Order a probe move to a position in active co-ordinates at ``feed`` mm/min."""
        self.modal.position = target
        end, stop = self._convert_to_machine_mm(block, target), Corner("exact_stop")
        self._append_motion(block, Probe(block.line, end, feed, stop, self._find_turned_axes(block, target)))

    def set_position(self, block: Block, position: list[float]) -> None:
        """Set the position without ordering a motion (the operator moves)."""
        self.modal.position = position
        self._convert_to_machine_mm(block, position)
