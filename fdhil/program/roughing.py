"""G70 to G72.2: finishing and roughing of a turned contour, described by a subroutine (Q) in lines and arcs.

G71 cuts along Z, G72 along X; .1 omits pockets, .2 cuts only the pockets. D is the finishing allowance, I the depth of
a cut, R the retract; G70 follows the contour P times from the distance D to E.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fdhil.program.arcs import centre_of_radius, radii_agree
from fdhil.program.contour import Contour, ContourError, Part
from fdhil.program.machine import Machine
from fdhil.program.modal import Modal
from fdhil.program.motions import PLANE_AXES, swept
from fdhil.program.targets import feed_mm_min, length_mm
from fdhil.program.words import Block, g_word

CODES = (700, 710, 711, 712, 720, 721, 722)
FINISH = 700
_ALONG_X = (720, 721, 722)
_STRAIGHT = (0, 10)
_ARC = (20, 30)
_NEAR = 1e-6
_TOUCH = 1e-3
_DEEPEST = -1e9
_SAME_PLACE = 1e-4
_POCKETS_LEFT = 3


@dataclass(slots=True)
class Drawn:
    """The contour that a subroutine's blocks draw from ``at`` on, z + j x in program units."""

    modal: Modal
    motion: int
    at: complex
    parts: list[Part] = field(default_factory=list)

    def add(self, block: Block) -> None:
        """Add a block; ProgramError for an arc without centre, and for contradictory words."""
        words, old = block.words, self.at
        self.motion = block.g.get("motion", self.motion)
        new = complex(self._end(block, "z", "w", old.real, 1.0), self._end(block, "x", "u", old.imag, self._per_x()))
        if new == old:
            return
        self.at = new
        self.modal.position[2], self.modal.position[0] = new.real * self.modal.scale, new.imag * self.modal.scale
        if self.motion in _STRAIGHT:
            self.parts.append(Part(old, new))
        elif self.motion in _ARC:
            self.parts.append(Part(old, new, self._centre(block, old, new), self.motion == 30))
        else:
            return
        if "a" in words and "c" in words:
            raise block.fault("c", "contradicts A at the same corner; use one of them")
        if "a" in words or "c" in words:
            rounded = "a" in words
            self.parts.append(Part(new, new, new if rounded else None, corner=words["a" if rounded else "c"]))

    def _per_x(self) -> float:
        return 0.5 if self.modal.diameter else 1.0

    def _end(self, block: Block, letter: str, step: str, old: float, share: float) -> float:
        words = block.words
        if step in words:
            if letter in words or not self.modal.absolute:
                raise block.fault(step, f"contradicts {letter.upper()} or G91 in a contour; use one of them")
            return old + words[step] * share
        if letter not in words:
            return old
        return words[letter] * share + (0.0 if self.modal.absolute else old)

    def _centre(self, block: Block, old: complex, new: complex) -> complex:
        words = block.words
        given = [letter for letter in "ik" if letter in words]
        if ("r" in words) == bool(given):
            raise block.fault(g_word(self.motion), "an arc needs its centre (I K) or its radius (R)")
        if "r" in words:
            if words["r"] ** 2 < abs(new - old) ** 2 / 4.0:
                raise block.fault("r", "is too small a radius to reach the end")
            return centre_of_radius(old, new, abs(words["r"]), self.motion == 20)
        centre = complex(words.get("k", 0.0), words.get("i", 0.0))
        return centre if self.modal.arc_absolute else old + centre


def start_of(machine: Machine, block: Block) -> complex:
    """Move to the start of a cycle, X and Z of its block, and return it; ProgramError if the cycle cannot begin."""
    modal, words = machine.modal, block.words
    code = modal.code
    if "q" not in words:
        raise block.fault(code, "needs Q, the number of the subroutine with its contour")
    if modal.plane != 1:
        raise block.fault(code, "works in the XZ plane; use G18")
    if words.get("i", 1.0) <= 0.0:
        raise block.fault("i", "is not a valid depth of cut; I must be positive")
    if machine.compensation is not None and modal.motion != FINISH:
        raise block.fault(code, "cannot be used with cutter compensation on")
    start, first = list(modal.position), list(modal.position)
    for axis, letter in ((0, "x"), (2, "z")):
        if letter in words:
            value = length_mm(modal, axis, words[letter])
            start[axis] = value if modal.absolute else start[axis] + value
            first[axis] = value  # the reference reads the words of the first rapid as absolute under G91 too
    machine.rapid_beside(block, first)
    return complex(start[2], start[0]) / modal.scale


def work(machine: Machine, block: Block, drawn: Drawn, start: complex) -> None:
    """Order the cycle of a block along the drawn contour, from ``start`` (program units)."""
    code, parts = machine.modal.motion, drawn.parts
    if len(parts) < 2:
        return
    parts[0].start = start
    tool = Tool(machine, block, Contour(parts))
    try:
        if code == FINISH:
            _finish(tool, block.words.get("d", 0.0), block.words.get("e", 0.0), block.words.get("p", 1.0))
        else:
            _rough(tool, code, block.words)
    except ContourError as error:
        raise block.fault(g_word(code), str(error)) from None


@dataclass(slots=True)
class Tool:
    """Orders motions along a contour in any orientation."""

    machine: Machine
    block: Block
    contour: Contour

    def rapid(self, place: complex) -> None:
        """Move to a point at rapid speed."""
        self.machine.rapid_to(self.block, self.whole(place))

    def feed(self, place: complex) -> None:
        """Move straight to a point at the feed in force."""
        self.machine.feed_to(self.block, self.whole(place))

    def follow(self, part: Part, end: complex) -> None:
        """Follow a line or an arc to ``end``."""
        if part.centre is None:
            self.feed(end)
            return
        modal, block = self.machine.modal, self.block
        ccw = part.ccw != self.contour.mirrored
        here = complex(modal.position[2], modal.position[0])
        centre, there = (self.contour.programmed(place) * modal.scale for place in (part.centre, end))
        if max(abs((there - here).real), abs((there - here).imag)) < _SAME_PLACE * modal.scale:
            return
        target, turns = self.whole(end), 1 if ccw else -1
        path = swept(modal.position, target, centre, turns, PLANE_AXES["XZ"])
        if not radii_agree(*path.radii, modal.scale):
            raise ContourError("an arc of its contour begins and ends at different radii; correct its centre")
        feed = feed_mm_min(modal, block, path.length_mm)
        self.machine.arc_to(block, target, centre, turns, feed, path.angle_rad)

    def whole(self, place: complex) -> list[float]:
        """Return a point in active co-ordinates of all axes."""
        there = self.contour.programmed(place) * self.machine.modal.scale
        whole = list(self.machine.modal.position)
        whole[2], whole[0] = there.real, there.imag
        return whole


def _finish(tool: Tool, first: float, last: float, passes: float) -> None:
    if passes > tool.machine.budget.max_motions_per_block:
        raise tool.block.fault(f"P{passes:g}", "is too many passes; split them")
    contour = tool.contour
    contour.lay_out(along_x=_wants_turn(contour))
    for number in range(int(passes), 0, -1):
        path = contour.copy()
        path.widen((number - 1) * (first - last) / passes + last)
        tool.machine.rapid_beside(tool.block, tool.whole(path.parts[0].start))
        tool.rapid(path.parts[0].end)
        for part in path.parts[1:]:
            tool.follow(part, part.end)


def _wants_turn(contour: Contour) -> bool:
    """Return whether the contour without its first part continues along X only, not along Z."""
    rest = Contour(contour.copy().parts[1:])
    rest.lead_down()
    turned = not all(part.falls() for part in rest.parts)
    if turned:
        rest.quarter()
        rest.lead_down()
    rest.check_falling()
    return turned


def _rough(tool: Tool, code: int, words: dict[str, float]) -> None:
    contour = tool.contour
    contour.lay_out(along_x=code in _ALONG_X)
    contour.widen(words.get("d", 0.0))
    first, last = contour.parts[0], contour.parts[-1]
    tool.rapid(first.start)
    if last.end.imag < first.start.imag:
        contour.parts.append(Part(last.end, complex(last.end.real, first.start.imag)))
    depth = max(words.get("i", 1.0), 2 * _NEAR)
    Roughing(tool, depth, words.get("r", 0.5) * (1.0 + 1.0j), [first.start]).cut(code % 10)


@dataclass(slots=True)
class Roughing:
    """Cuts of ``depth`` down along the contour; after each one the tool retracts by ``escape``."""

    tool: Tool
    depth: float
    escape: complex
    begun: list[complex]  # entries of the active pockets
    at: complex = 0.0 + 0.0j
    level: float = 0.0
    turns: int = 0

    def cut(self, kind: int) -> None:
        """Cut all (0), all but the pockets (1), or only the pockets (2)."""
        parts = self.tool.contour.parts
        self.at = parts[0].start
        place = 0
        if kind == 2:
            self.level = self.at.imag
            while place < len(parts) and not self._dive(place, _DEEPEST):
                place += 1
            kind = _POCKETS_LEFT
        entry: int | None = place
        while entry is not None:
            entry = self._pocket(entry, kind)

    def _count(self) -> None:
        self.turns += 1
        if self.turns > self.tool.machine.budget.max_motions_per_block:
            raise ContourError("it needs too many cuts, or its contour cannot be followed; use a larger I")

    def _pocket(self, place: int, kind: int) -> int | None:
        parts = self.tool.contour.parts
        self.level = self.begun[-1].imag
        while place < len(parts):
            self._count()
            self._lower()
            if self._dive(place, self.level):
                return self._along_contour(place, kind)
            if abs(self.at.imag - self.level) > _NEAR:
                place += 1  # this part ends above the level
                continue
            place = self._pass(place)
        return None

    def _lower(self) -> None:
        above = self.level - _NEAR - self.at.imag
        if above > 1e6 * self.depth:
            raise ContourError("it needs too many cuts; use a larger I")
        while self.level - _NEAR > self.at.imag:
            self.level -= self.depth

    def _pass(self, place: int) -> int:
        parts = self.tool.contour.parts
        for hit in range(place, len(parts)):
            found = parts[hit].crossings(self.at.imag)
            if not found:
                continue
            z = found[0] if hit != place else found[-1]
            distance = abs(z - self.at.real)
            if z - _NEAR > self.at.real or (distance < _NEAR and hit == place):
                continue  # only at the start of this part
            if distance < _NEAR:
                if abs(self.at - parts[hit].start) < _NEAR:
                    return hit
                self.level -= self.depth
                return place
            end = complex(z, self.at.imag)
            share = min(1.0, distance / 2.0 / self.escape.real) if self.escape.real else 1.0
            self.tool.feed(end)
            self.tool.rapid(end + share * self.escape)
            self.tool.rapid(self.at - (share * self.escape).conjugate())
            (self.tool.rapid if place == 0 else self.tool.feed)(self.at)
            self.level -= self.depth
            break
        return place

    def _along_contour(self, place: int, kind: int) -> int | None:
        parts = self.tool.contour.parts
        for number in range(place, len(parts)):
            if kind == 1:
                self._climb_only(parts[number])
            elif self._climb(parts[number]):
                if kind == _POCKETS_LEFT:
                    self._begin_pocket()
                return number
        return None

    def _begin_pocket(self) -> None:
        if self.at.imag > self.begun[-1].imag and len(self.begun) > 1:
            self.begun.pop()
        if len(self.begun) == 1:
            self.begun.append(self.at)

    def _dive(self, place: int, x: float) -> bool:
        """Follow a part down to the height ``x``; True if it does not lead down."""
        part = self.tool.contour.parts[place]
        if part.centre is not None:
            return self._dive_arc(part, part.centre, x)
        if part.start.imag <= part.end.imag + _NEAR:
            return True
        end = part.end
        if not x < part.end.imag:
            found = part.crossings(x)
            if not found:
                raise ContourError("its contour begins below the start of the cut")
            end = complex(found[0], x)
        (self.tool.rapid if place == 0 else self.tool.feed)(end)
        self.at = end
        return False

    def _dive_arc(self, part: Part, centre: complex, x: float) -> bool:
        ahead = (self.at - part.end).real
        if abs(self.at - part.end) < _NEAR or ahead <= _NEAR:
            self.at = part.end
            return False
        found = part.crossings(x) or part.crossings(x - _NEAR)
        if self.at.real - _NEAR > centre.real if part.ccw else self.at.real <= centre.real:
            return True
        end = part.end
        if part.ccw:
            if found and found[-1] <= centre.real:
                end = complex(found[-1], x)
        elif found:
            if found[0] < centre.real:
                return False  # reached only from behind: the next level will cut it
            end = complex(found[0], x)
        self.tool.follow(part, end)
        self.at = end
        return False

    def _climb(self, part: Part) -> bool:
        """Follow a part up; True if it does not lead up to its end."""
        if part.centre is None:
            if part.end.imag + _NEAR < part.start.imag:
                return True
            if abs(self.at - part.start) > _NEAR:
                raise ContourError("its contour has a gap")
            self.tool.feed(part.end)
            self.at = part.end
            return False
        behind = self.at.real < part.centre.real if part.ccw else self.at.real > part.centre.real
        if not behind:
            self._follow_up(part)
        return behind or part.ccw

    def _climb_only(self, part: Part) -> None:
        if part.centre is None and part.end.imag < part.start.imag:
            return
        found = part.crossings(self.at.imag)
        if not found:
            return
        z = found[0]
        if part.centre is not None:
            z = found[0] if part.ccw else found[-1]
            if (z < part.centre.real) if part.ccw else (z > part.centre.real):
                return
        self.at = complex(z, self.at.imag)
        self.tool.feed(self.at)
        if part.centre is None:
            self.tool.feed(part.end)
            self.at = part.end
        else:
            self._follow_up(part)

    def _follow_up(self, part: Part) -> None:
        """Follow an arc to its end, or to its crest if it falls after that."""
        end = part.end
        assert part.centre is not None
        if part.ccw and end.real < part.centre.real:
            end = complex(part.centre.real, part.centre.imag + abs(part.start - part.centre))
        if abs(self.at - end) > _TOUCH:
            self.tool.follow(part, end)
        self.at = end
