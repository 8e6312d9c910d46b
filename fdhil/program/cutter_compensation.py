"""Cutter compensation (G41, G42): the path of the tool's centre parallel to the programmed one.

Each programmed line or arc becomes its parallel at the tool's radius. Outside corners get an arc around the corner; at
inside corners both parallels end at their intersection, so a motion is ordered only when the next one is known. Moves
along the normal and dwells in between are deferred with it. Points in the plane are complex: first + j second.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, field, replace

from fdhil.program.motions import Dwell
from fdhil.program.words import Block

_TANGENT_RAD = 0.05  # flatter corners are passed as if the path were smooth
_BACKWARDS_MM = 1e-6
_TIPS = {1: 1 - 1j, 2: -1 - 1j, 3: -1 + 1j, 4: 1 + 1j, 5: 1, 6: -1j, 7: -1, 8: 1j}  # z + j x
_WRAPPED_RAD = 0.3  # an arc longer than programmed by this angle was cut beyond its other end


@dataclass(slots=True)
class CompensatedPiece:
    """A line or an arc of the tool's centre: from ``start`` to ``end`` in the plane, ``whole`` its end on all axes.

    ``heading`` and ``leaving`` are the programmed directions at its ends, ``corner`` the programmed end. An arc has
    ``centre`` and ``turns``; ``feed`` is None for a rapid.
    """

    block: Block
    start: complex
    end: complex
    corner: complex
    heading: complex
    leaving: complex
    whole: list[float]
    feed: float | None
    centre: complex | None = None
    turns: int = 0
    angle: float = 0.0  # largest sweep of an arc before it is cut at its ends
    waiting: list[DeferredAction] = field(default_factory=list)
    given: bool = False  # its motion has been ordered
    checked_along: complex | None = None  # direction that it must not reverse, if not ``leaving``

    @property
    def radius(self) -> float:
        """Radius of an arc's parallel at its end."""
        return 0.0 if self.centre is None else abs(self.end - self.centre)


@dataclass(slots=True)
class DeferredAction:
    """An action at the end of a piece: a dwell, or a move of the other axes to ``whole``."""

    block: Block
    dwell: Dwell | None = None
    whole: list[float] = field(default_factory=list)
    feed: float | None = None


@dataclass(slots=True)
class CutterCompensation:
    """Compensation by ``radius_mm`` on one ``side`` (1 left, -1 right) of the path.

    ``orientation`` 1 to 8 is the position of a turning tool's tip relative to the centre of its nose.
    """

    radius_mm: float
    side: int
    orientation: int = 0
    entered: bool = False
    pending: CompensatedPiece | None = None

    def add_line(
        self, block: Block, start: complex, corner: complex, whole: list[float], feed: float | None
    ) -> list[CompensatedPiece]:
        """Add a programmed line in the plane; return the pieces that it completes."""
        length = abs(corner - start)
        if not self.entered and length <= self.radius_mm:
            raise block.build_error(f"G{41 if self.side > 0 else 42}",
                               "the move that enters compensation must be longer than the tool's radius")  # fmt: skip
        way = (corner - start) / length
        aside = 1j * self.side * self.radius_mm * way
        begin = start + aside if self.entered else start
        piece = CompensatedPiece(block, begin, corner + aside, corner, way, way, whole, feed)
        if not self.entered:
            piece.checked_along = aside  # as in the reference: it may enter backwards
        return self._join_piece(piece)

    def add_arc(
        self, block: Block, start: complex, corner: complex, centre: complex, turns: int, whole: list[float],
        feed: float, angle: float,
    ) -> list[CompensatedPiece]:  # fmt: skip
        """Add a programmed arc of ``angle``; return the pieces that it completes."""
        sense = 1 if turns > 0 else -1
        near, far = abs(start - centre), abs(corner - centre)
        inward = self.side * sense * self.radius_mm
        if min(near, far) - inward <= 0.0 or (not self.entered and far < self.radius_mm):
            raise block.build_error("G2" if turns < 0 else "G3", "the arc's radius must exceed the tool's")
        end = centre + (far - inward) / far * (corner - centre)
        heading, leaving = 1j * sense * (start - centre) / near, 1j * sense * (corner - centre) / far
        if self.entered:
            begin = centre + (near - inward) / near * (start - centre)
        else:
            begin, centre, angle = start, _compute_entry_centre(block, start, end, centre, corner), 2.0 * math.pi
        return self._join_piece(
            CompensatedPiece(block, begin, end, corner, heading, leaving, whole, feed, centre, turns, abs(angle))
        )

    def defer_action(self, waiting: DeferredAction) -> bool:
        """Defer an action until the end of the pending piece is known; False if nothing is pending."""
        if self.pending is None:
            return False
        self.pending.waiting.append(waiting)
        return True

    @property
    def tip(self) -> complex:
        """Position of the tool's tip relative to the centre of its nose, z + j x in mm."""
        return _TIPS.get(self.orientation, 0) * self.radius_mm

    def settle_pending(self) -> list[CompensatedPiece]:
        """Return the pending piece as it is: the machine stops there, but the next corner is still cut or rounded."""
        if self.pending is None or self.pending.given:
            return []
        piece = replace(self.pending, waiting=[])
        self.pending.given = True
        return [piece]

    def flush_pending(self) -> list[CompensatedPiece]:
        """Return the pending piece, which no further motion will change."""
        last, self.pending = self.pending, None
        return [_check_gouging(last, last.block)] if last is not None else []

    def _join_piece(self, piece: CompensatedPiece) -> list[CompensatedPiece]:
        before, self.pending, self.entered = self.pending, piece, True
        if before is None:
            return []
        turn = self._compute_turn_rad(before, piece)
        settled = [before]
        if turn < -_TANGENT_RAD and self.radius_mm > 0.0:
            settled.append(self._build_corner_arc(before, piece))
        elif turn > _TANGENT_RAD:
            before.end = piece.start = _find_crossing(before, piece, self.radius_mm, self.side)
        else:
            piece.start = before.end
        _check_gouging(before, piece.block)
        return settled

    def _compute_turn_rad(self, before: CompensatedPiece, piece: CompensatedPiece) -> float:
        """Return the angle (rad) by which the path turns toward the tool's side: positive at an inside corner.

        A reversal is an outside corner, unless the arcs that meet both bend away from the tool.
        """
        turn = self.side * _compute_angle_rad(before.leaving, piece.heading)
        if abs(turn) <= math.pi - _TANGENT_RAD:
            return turn
        bend = sum(p.turns / abs(p.turns) / p.radius for p in (before, piece) if p.centre is not None)
        return math.pi if self.side * bend < 0.0 else -math.pi

    def _build_corner_arc(self, before: CompensatedPiece, piece: CompensatedPiece) -> CompensatedPiece:
        """Return the arc around an outside corner, at the height of the piece before it; a rapid goes straight."""
        last = before.waiting[-1].whole if before.waiting and before.waiting[-1].whole else before.whole
        whole = next((w.whole for w in reversed(before.waiting) if w.whole), last)
        return CompensatedPiece(
            piece.block, before.end, piece.start, before.corner, before.leaving, piece.heading, list(whole), piece.feed,
            before.corner, -self.side, 2.0 * math.pi,
        )  # fmt: skip


def _check_gouging(piece: CompensatedPiece, block: Block) -> CompensatedPiece:
    if piece.centre is None:
        along = piece.checked_along or piece.leaving
        forward = _compute_dot_product(piece.end - piece.start, along)
        gouges = forward < -_BACKWARDS_MM
    else:
        turned = _compute_sweep_rad(piece)
        gouges = turned > piece.angle + _WRAPPED_RAD and turned * piece.radius > _BACKWARDS_MM
    if gouges:
        raise block.build_error("", "the tool would gouge beyond the inside corner; use a smaller tool")
    return piece


def _compute_sweep_rad(piece: CompensatedPiece) -> float:
    assert piece.centre is not None
    sense = 1 if piece.turns > 0 else -1
    turned = (sense * _compute_angle_rad(piece.start - piece.centre, piece.end - piece.centre)) % (2.0 * math.pi)
    if turned < 1e-9 or turned > 2.0 * math.pi - 1e-9:
        turned = 2.0 * math.pi if piece.angle > math.pi else 0.0
    return turned + (abs(piece.turns) - 1) * 2.0 * math.pi


def _find_crossing(before: CompensatedPiece, piece: CompensatedPiece, radius: float, side: int) -> complex:
    """Return the intersection of two pieces' parallels at an inside corner that is nearest to the corner."""
    corner = before.corner
    if before.centre is None and piece.centre is None:
        share = side * radius / (1.0 + _compute_dot_product(before.leaving, piece.heading))
        return corner + share * 1j * (before.leaving + piece.heading)
    if before.centre is None:
        found = _intersect_line_and_circle(before.end, before.leaving, piece)
    elif piece.centre is None:
        found = _intersect_line_and_circle(piece.start, piece.heading, before)
    else:
        found = _intersect_circles(before, piece)
    if not found:
        raise piece.block.build_error("", "the tool does not fit into the inside corner; use a smaller tool")
    return min(found, key=lambda point: (_is_arc_lengthened(before, piece, point), abs(point - corner)))


def _is_arc_lengthened(before: CompensatedPiece, piece: CompensatedPiece, point: complex) -> bool:
    cut = (replace(before, end=point), replace(piece, start=point))
    return any(part.centre is not None and _compute_sweep_rad(part) > part.angle + _WRAPPED_RAD for part in cut)


def _intersect_line_and_circle(point: complex, way: complex, arc: CompensatedPiece) -> list[complex]:
    assert arc.centre is not None
    off = point - arc.centre
    along = _compute_dot_product(off, way)
    rest = arc.radius**2 - (_compute_dot_product(off, off) - along * along)
    if rest < -1e-9 * arc.radius**2:
        return []
    half = math.sqrt(max(0.0, rest))
    return [point + (s - along) * way for s in (-half, half)]


def _intersect_circles(one: CompensatedPiece, two: CompensatedPiece) -> list[complex]:
    assert one.centre is not None
    assert two.centre is not None
    r1, r2 = one.radius, abs(two.start - two.centre)
    between = abs(two.centre - one.centre)
    if between < 1e-12:
        return []
    along = (between * between + r1 * r1 - r2 * r2) / (2.0 * between)
    rest = r1 * r1 - along * along
    if rest < -1e-9 * r1 * r1:
        return []
    height = math.sqrt(max(0.0, rest))
    way = (two.centre - one.centre) / between
    return [one.centre + (along + s * 1j) * way for s in (-height, height)]


def _compute_entry_centre(block: Block, start: complex, end: complex, centre: complex, corner: complex) -> complex:
    """Return the centre of the arc that enters compensation: from the tool's position to the programmed tangent."""
    inward = (centre - corner) / abs(centre - corner)
    chord = end - start
    along = _compute_dot_product(inward, chord)
    if abs(along) < 1e-12:
        raise block.build_error("", "this arc cannot enter compensation; enter by a straight move")
    return end - _compute_dot_product(chord, chord) / (2.0 * along) * inward


def _compute_dot_product(a: complex, b: complex) -> float:
    return (a.conjugate() * b).real


def _compute_angle_rad(a: complex, b: complex) -> float:
    return cmath.phase(a.conjugate() * b)
