"""Cutter compensation (G41, G42): the path of the tool's centre beside the programmed one.

Each programmed line or arc becomes its parallel at the tool's radius. Outside corners get an arc about the corner; at
inside corners both parallels end where they cross, so a motion can be given out only when the next one is known. What
lies between (moves along the normal, dwells) waits with it. All in the plane's co-ordinates (first, second).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from fdhil.program.motions import Dwell
from fdhil.program.words import Block

Vector = tuple[float, float]
_TANGENT_RAD = 0.05  # flatter corners are passed as if the path were smooth
_BACKWARDS_MM = 1e-6
_TIPS = {1: (1, -1), 2: (-1, -1), 3: (-1, 1), 4: (1, 1), 5: (1, 0), 6: (0, -1), 7: (-1, 0), 8: (0, 1)}
_WRAPPED_RAD = 0.3  # an arc that turns so much more than programmed was cut beyond its other end


@dataclass(slots=True)
class Piece:
    """A line or an arc of the tool's centre: from ``start`` to ``end`` in the plane, ``whole`` its end on all axes.

    ``heading`` and ``leaving`` are the programmed directions at its ends, ``corner`` the programmed end. An arc has
    ``centre`` and ``turns``; ``feed`` is None for a rapid.
    """

    block: Block
    start: Vector
    end: Vector
    corner: Vector
    heading: Vector
    leaving: Vector
    whole: list[float]
    feed: float | None
    centre: Vector | None = None
    turns: int = 0
    angle: float = 0.0  # what an arc may turn at most before it is cut at its ends
    waiting: list[Waiting] = field(default_factory=list)
    given: bool = False  # its motion was ordered already
    checked_along: Vector | None = None  # the way that it may not go against, where that is not ``leaving``

    @property
    def radius(self) -> float:
        """Radius of an arc's parallel at its end."""
        centre = self.centre or self.end
        return math.dist(centre, self.end)


@dataclass(slots=True)
class Waiting:
    """What happens at the end of a piece, wherever that will be: a dwell, or a move of the other axes to ``whole``."""

    block: Block
    dwell: Dwell | None = None
    whole: list[float] = field(default_factory=list)
    feed: float | None = None


@dataclass(slots=True)
class Compensation:
    """Compensation by ``radius_mm`` on one ``side`` (1 left, -1 right) of the path.

    ``orientation`` 1 to 8 tells where the tip of a turning tool lies about the centre of its nose.
    """

    radius_mm: float
    side: int
    orientation: int = 0
    entered: bool = False
    pending: Piece | None = None

    def line(self, block: Block, start: Vector, corner: Vector, whole: list[float], feed: float | None) -> list[Piece]:
        """Take a programmed line that moves in the plane; return the pieces that are settled by it."""
        length = math.dist(start, corner)
        if not self.entered and length <= self.radius_mm:
            raise block.fault(f"G{41 if self.side > 0 else 42}",
                               "the move that enters compensation must be longer than the tool's radius")  # fmt: skip
        way = ((corner[0] - start[0]) / length, (corner[1] - start[1]) / length)
        aside = self._aside(way)
        begin = _plus(start, aside) if self.entered else start
        piece = Piece(block, begin, _plus(corner, aside), corner, way, way, whole, feed)
        if not self.entered:
            piece.checked_along = aside  # as the reference does: it may enter backwards, to its side alone
        return self._next(piece)

    def arc(
        self, block: Block, start: Vector, corner: Vector, centre: Vector, turns: int, whole: list[float], feed: float,
        angle: float,
    ) -> list[Piece]:  # fmt: skip
        """Take a programmed arc of ``angle``; return the pieces that are settled by it."""
        sense = 1 if turns > 0 else -1
        near, far = math.dist(start, centre), math.dist(corner, centre)
        inward = self.side * sense * self.radius_mm
        if min(near, far) - inward <= 0.0 or (not self.entered and far < self.radius_mm):
            raise block.fault("G2" if turns < 0 else "G3", "the arc's radius must exceed the tool's")
        end = _toward(centre, corner, far - inward)
        heading, leaving = _tangent(centre, start, sense), _tangent(centre, corner, sense)
        if self.entered:
            begin = _toward(centre, start, near - inward)
        else:
            begin, centre, angle = start, _entry_centre(block, start, end, centre, corner), 2.0 * math.pi
        return self._next(Piece(block, begin, end, corner, heading, leaving, whole, feed, centre, turns, abs(angle)))

    def wait(self, waiting: Waiting) -> bool:
        """Keep something until the end of the pending piece is known; False when nothing is pending."""
        if self.pending is None:
            return False
        self.pending.waiting.append(waiting)
        return True

    @property
    def tip(self) -> Vector:
        """Where the tool's tip lies from the centre of its nose (z, x) in mm."""
        z, x = _TIPS.get(self.orientation, (0, 0))
        return z * self.radius_mm, x * self.radius_mm

    def settle(self) -> list[Piece]:
        """Return what is pending as it is now: the machine stops there, but the next corner is still cut or rounded."""
        if self.pending is None or self.pending.given:
            return []
        piece = replace(self.pending, waiting=[])
        self.pending.given = True
        return [piece]

    def flush(self) -> list[Piece]:
        """Return what is pending: no further motion will change it."""
        last, self.pending = self.pending, None
        return [_checked(last, last.block)] if last is not None else []

    def _aside(self, way: Vector) -> Vector:
        return (-way[1] * self.side * self.radius_mm, way[0] * self.side * self.radius_mm)

    def _next(self, piece: Piece) -> list[Piece]:
        before, self.pending, self.entered = self.pending, piece, True
        if before is None:
            return []
        turn = self._turn(before, piece)
        settled = [before]
        if turn < -_TANGENT_RAD and self.radius_mm > 0.0:
            settled.append(self._round(before, piece))
        elif turn > _TANGENT_RAD:
            before.end = piece.start = _crossing(before, piece, self.radius_mm, self.side)
        else:
            piece.start = before.end
        _checked(before, piece.block)
        return settled

    def _turn(self, before: Piece, piece: Piece) -> float:
        """Angle (rad) by which the path turns toward the tool's side: positive at an inside corner.

        Turning back is an outside corner, unless the arcs that meet both bend away from the tool.
        """
        turn = self.side * _angle(before.leaving, piece.heading)
        if abs(turn) <= math.pi - _TANGENT_RAD:
            return turn
        bend = sum(p.turns / abs(p.turns) / p.radius for p in (before, piece) if p.centre is not None)
        return math.pi if self.side * bend < 0.0 else -math.pi

    def _round(self, before: Piece, piece: Piece) -> Piece:
        """The arc about an outside corner, at the height of the piece before it; a rapid goes straight."""
        last = before.waiting[-1].whole if before.waiting and before.waiting[-1].whole else before.whole
        whole = next((w.whole for w in reversed(before.waiting) if w.whole), last)
        return Piece(piece.block, before.end, piece.start, before.corner, before.leaving, piece.heading, list(whole),
                     piece.feed, before.corner, -self.side, 2.0 * math.pi)  # fmt: skip


def _checked(piece: Piece, block: Block) -> Piece:
    """Return a piece whose ends are final; ProgramError when cutting it has turned it round."""
    if piece.centre is None:
        along = piece.checked_along or piece.leaving
        forward = sum((e - s) * w for s, e, w in zip(piece.start, piece.end, along, strict=True))
        gouges = forward < -_BACKWARDS_MM
    else:
        turned = _sweep(piece)
        gouges = turned > piece.angle + _WRAPPED_RAD and turned * piece.radius > _BACKWARDS_MM
    if gouges:
        raise block.fault("", "the tool would gouge beyond the inside corner; take a smaller one")
    return piece


def _sweep(piece: Piece) -> float:
    assert piece.centre is not None
    begin, end = _minus(piece.start, piece.centre), _minus(piece.end, piece.centre)
    sense = 1 if piece.turns > 0 else -1
    turned = (sense * _angle(begin, end)) % (2.0 * math.pi)
    if turned < 1e-9 or turned > 2.0 * math.pi - 1e-9:
        turned = 2.0 * math.pi if piece.angle > math.pi else 0.0
    return turned + (abs(piece.turns) - 1) * 2.0 * math.pi


def _crossing(before: Piece, piece: Piece, radius: float, side: int) -> Vector:
    """Where the parallels of two pieces cross at an inside corner, next to the corner."""
    corner = before.corner
    if before.centre is None and piece.centre is None:
        a, b = _left(before.leaving), _left(piece.heading)
        share = side * radius / (1.0 + a[0] * b[0] + a[1] * b[1])
        return (corner[0] + share * (a[0] + b[0]), corner[1] + share * (a[1] + b[1]))
    if before.centre is None:
        found = _line_and_circle(before.end, before.leaving, piece)
    elif piece.centre is None:
        found = _line_and_circle(piece.start, piece.heading, before)
    else:
        found = _circles(before, piece)
    if not found:
        raise piece.block.fault("", "the tool does not fit into the inside corner; take a smaller one")
    return min(found, key=lambda point: (_turned_round(before, piece, point), math.dist(point, corner)))


def _turned_round(before: Piece, piece: Piece, point: Vector) -> bool:
    """Tell whether cutting two pieces at ``point`` would make an arc of them longer than programmed."""
    cut = (replace(before, end=point), replace(piece, start=point))
    return any(part.centre is not None and _sweep(part) > part.angle + _WRAPPED_RAD for part in cut)


def _line_and_circle(point: Vector, way: Vector, arc: Piece) -> list[Vector]:
    assert arc.centre is not None
    radius = math.dist(arc.centre, arc.end)
    off = _minus(point, arc.centre)
    along = off[0] * way[0] + off[1] * way[1]
    rest = radius * radius - (off[0] * off[0] + off[1] * off[1] - along * along)
    if rest < -1e-9 * radius * radius:
        return []
    half = math.sqrt(max(0.0, rest))
    return [(point[0] + (s - along) * way[0], point[1] + (s - along) * way[1]) for s in (-half, half)]


def _circles(one: Piece, two: Piece) -> list[Vector]:
    assert one.centre is not None
    assert two.centre is not None
    r1, r2 = math.dist(one.centre, one.end), math.dist(two.centre, two.start)
    between = math.dist(one.centre, two.centre)
    if between < 1e-12:
        return []
    along = (between * between + r1 * r1 - r2 * r2) / (2.0 * between)
    rest = r1 * r1 - along * along
    if rest < -1e-9 * r1 * r1:
        return []
    height = math.sqrt(max(0.0, rest))
    way = _minus(two.centre, one.centre)
    way = (way[0] / between, way[1] / between)
    foot = (one.centre[0] + along * way[0], one.centre[1] + along * way[1])
    return [(foot[0] - s * way[1], foot[1] + s * way[0]) for s in (-height, height)]


def _entry_centre(block: Block, start: Vector, end: Vector, centre: Vector, corner: Vector) -> Vector:
    """Centre of the arc that enters compensation: from the tool's place, tangent to the programmed arc at its end."""
    radius = math.dist(centre, corner)
    inward = ((centre[0] - corner[0]) / radius, (centre[1] - corner[1]) / radius)
    chord = _minus(end, start)
    along = inward[0] * chord[0] + inward[1] * chord[1]
    if abs(along) < 1e-12:
        raise block.fault("", "this arc cannot enter compensation; enter it by a straight move")
    reach = -(chord[0] * chord[0] + chord[1] * chord[1]) / (2.0 * along)
    return (end[0] + reach * inward[0], end[1] + reach * inward[1])


def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1])


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1])


def _left(way: Vector) -> Vector:
    return (-way[1], way[0])


def _toward(centre: Vector, point: Vector, radius: float) -> Vector:
    share = radius / math.dist(centre, point)
    return (centre[0] + (point[0] - centre[0]) * share, centre[1] + (point[1] - centre[1]) * share)


def _tangent(centre: Vector, point: Vector, sense: int) -> Vector:
    radius = math.dist(centre, point)
    return (-sense * (point[1] - centre[1]) / radius, sense * (point[0] - centre[0]) / radius)


def _angle(a: Vector, b: Vector) -> float:
    """Signed angle from one vector to another, -pi to pi."""
    return math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
