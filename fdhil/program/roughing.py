"""G70 to G72.2: finishing and roughing of a turned contour, described by a subroutine (Q) in lines and arcs.

G71 cuts along Z, G72 along X; .1 omits pockets, .2 cuts only the pockets. D is the finishing allowance, I the depth of
a cut, R the retract; G70 follows the contour P times from the distance D to E.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from fdhil.program.arcs import compute_arc_centre, is_radius_difference_allowed
from fdhil.program.modal_state import ModalState
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.motions import PLANE_AXES, sweep_arc
from fdhil.program.targets import compute_feed_mm_min, convert_to_mm
from fdhil.program.turned_contour import Contour, ContourError, ContourPart
from fdhil.program.words import Block, format_g_word

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
class DrawnContour:
    """The contour that a subroutine's blocks draw from ``at`` on, z + j x in program units."""

    modal: ModalState
    motion: int
    at: complex
    parts: list[ContourPart] = field(default_factory=list)

    def add_block(self, block: Block) -> None:
        """Add a block; ProgramError for an arc without centre, and for contradictory words."""
        words, old = block.words, self.at
        self.motion = block.g.get("motion", self.motion)
        new = complex(
            self._compute_end(block, "z", "w", old.real, 1.0),
            self._compute_end(block, "x", "u", old.imag, self._get_x_scale()),
        )
        if new == old:
            return
        self.at = new
        self.modal.position[2], self.modal.position[0] = new.real * self.modal.scale, new.imag * self.modal.scale
        if self.motion in _STRAIGHT:
            self.parts.append(ContourPart(old, new))
        elif self.motion in _ARC:
            self.parts.append(ContourPart(old, new, self._compute_centre(block, old, new), self.motion == 30))
        else:
            return
        if "a" in words and "c" in words:
            raise block.build_error("c", "contradicts A at the same corner; use one of them")
        if "a" in words or "c" in words:
            rounded = "a" in words
            self.parts.append(ContourPart(new, new, new if rounded else None, corner=words["a" if rounded else "c"]))

    def _get_x_scale(self) -> float:
        return 0.5 if self.modal.diameter else 1.0

    def _compute_end(self, block: Block, letter: str, step: str, old: float, share: float) -> float:
        words = block.words
        if step in words:
            if letter in words or not self.modal.absolute:
                raise block.build_error(step, f"contradicts {letter.upper()} or G91 in a contour; use one of them")
            return old + words[step] * share
        if letter not in words:
            return old
        return words[letter] * share + (0.0 if self.modal.absolute else old)

    def _compute_centre(self, block: Block, old: complex, new: complex) -> complex:
        words = block.words
        given = [letter for letter in "ik" if letter in words]
        if ("r" in words) == bool(given):
            raise block.build_error(format_g_word(self.motion), "an arc needs its centre (I K) or its radius (R)")
        if "r" in words:
            if words["r"] ** 2 < abs(new - old) ** 2 / 4.0:
                raise block.build_error("r", "is too small a radius to reach the end")
            return compute_arc_centre(old, new, abs(words["r"]), self.motion == 20)
        centre = complex(words.get("k", 0.0), words.get("i", 0.0))
        return centre if self.modal.arc_absolute else old + centre


def move_to_start(machine: MotionBuilder, block: Block) -> complex:
    """Move to the start of a cycle, X and Z of its block, and return it; ProgramError if the cycle cannot begin."""
    modal, words = machine.modal, block.words
    code = modal.code
    if "q" not in words:
        raise block.build_error(code, "needs Q, the number of the subroutine with its contour")
    if modal.plane != 1:
        raise block.build_error(code, "works in the XZ plane; use G18")
    if words.get("i", 1.0) <= 0.0:
        raise block.build_error("i", "is not a valid depth of cut; I must be positive")
    if machine.compensation is not None and modal.motion != FINISH:
        raise block.build_error(code, "cannot be used with cutter compensation on")
    start, first = list(modal.position), list(modal.position)
    for axis, letter in ((0, "x"), (2, "z")):
        if letter in words:
            value = convert_to_mm(modal, axis, words[letter])
            start[axis] = value if modal.absolute else start[axis] + value
            first[axis] = value  # the reference reads the words of the first rapid as absolute under G91 too
    machine.move_rapid_without_compensation(block, first)
    return complex(start[2], start[0]) / modal.scale


def order_contour_cycle(machine: MotionBuilder, block: Block, drawn: DrawnContour, start: complex) -> None:
    """Order the cycle of a block along the drawn contour, from ``start`` (program units)."""
    code, parts = machine.modal.motion, drawn.parts
    if len(parts) < 2:
        return
    parts[0].start = start
    tool = ContourTool(machine, block, Contour(parts))
    try:
        if code == FINISH:
            _finish_contour(tool, block.words.get("d", 0.0), block.words.get("e", 0.0), block.words.get("p", 1.0))
        else:
            _rough_contour(tool, code, block.words)
    except ContourError as error:
        raise block.build_error(format_g_word(code), str(error)) from None


@dataclass(slots=True)
class ContourTool:
    """Orders motions along a contour in any orientation."""

    machine: MotionBuilder
    block: Block
    contour: Contour

    def move_rapid_to(self, place: complex) -> None:
        """Move to a point at rapid speed."""
        self.machine.move_rapid_to(self.block, self.convert_to_position(place))

    def feed_to(self, place: complex) -> None:
        """Move straight to a point at the feed in force."""
        self.machine.feed_to(self.block, self.convert_to_position(place))

    def follow_part(self, part: ContourPart, end: complex) -> None:
        """Follow a line or an arc to ``end``."""
        if part.centre is None:
            self.feed_to(end)
            return
        modal, block = self.machine.modal, self.block
        ccw = part.ccw != self.contour.mirrored
        here = complex(modal.position[2], modal.position[0])
        centre, there = (self.contour.convert_to_program(place) * modal.scale for place in (part.centre, end))
        if max(abs((there - here).real), abs((there - here).imag)) < _SAME_PLACE * modal.scale:
            return
        target, turns = self.convert_to_position(end), 1 if ccw else -1
        path = sweep_arc(modal.position, target, centre, turns, PLANE_AXES["XZ"])
        if not is_radius_difference_allowed(*path.radii, modal.scale):
            raise ContourError("an arc of its contour begins and ends at different radii; correct its centre")
        feed = compute_feed_mm_min(modal, block, path.length_mm)
        self.machine.move_arc_to(block, target, centre, turns, feed, path.angle_rad)

    def convert_to_position(self, place: complex) -> list[float]:
        """Return a point in active co-ordinates of all axes."""
        there = self.contour.convert_to_program(place) * self.machine.modal.scale
        whole = list(self.machine.modal.position)
        whole[2], whole[0] = there.real, there.imag
        return whole


def _finish_contour(tool: ContourTool, first: float, last: float, passes: float) -> None:
    if passes > tool.machine.budget.max_motions_per_block:
        raise tool.block.build_error(f"P{passes:g}", "is too many passes; split them")
    contour = tool.contour
    contour.lay_out(along_x=_is_along_x(contour))
    for number in range(int(passes), 0, -1):
        path = contour.copy()
        path.move_to_parallel((number - 1) * (first - last) / passes + last)
        tool.machine.move_rapid_without_compensation(tool.block, tool.convert_to_position(path.parts[0].start))
        tool.move_rapid_to(path.parts[0].end)
        for part in path.parts[1:]:
            tool.follow_part(part, part.end)


def _is_along_x(contour: Contour) -> bool:
    """Return whether the contour without its first part continues along X only, not along Z."""
    rest = Contour(contour.copy().parts[1:])
    rest.mirror_downwards()
    turned = not all(part.is_falling() for part in rest.parts)
    if turned:
        rest.rotate_quarter_turn()
        rest.mirror_downwards()
    rest.check_falling()
    return turned


def _rough_contour(tool: ContourTool, code: int, words: dict[str, float]) -> None:
    contour = tool.contour
    contour.lay_out(along_x=code in _ALONG_X)
    contour.move_to_parallel(words.get("d", 0.0))
    first, last = contour.parts[0], contour.parts[-1]
    tool.move_rapid_to(first.start)
    if last.end.imag < first.start.imag:
        contour.parts.append(ContourPart(last.end, complex(last.end.real, first.start.imag)))
    depth = max(words.get("i", 1.0), 2 * _NEAR)
    Roughing(tool, depth, words.get("r", 0.5) * (1.0 + 1.0j), [first.start]).cut_contour(code % 10)


@dataclass(slots=True)
class Roughing:
    """Cuts of ``depth`` down along the contour; after each one the tool retracts by ``escape``."""

    tool: ContourTool
    depth: float
    escape: complex
    begun: list[complex]  # entries of the active pockets
    at: complex = 0.0 + 0.0j
    level: float = 0.0
    turns: int = 0

    def cut_contour(self, kind: int) -> None:
        """Cut all (0), all but the pockets (1), or only the pockets (2)."""
        parts = self.tool.contour.parts
        self.at = parts[0].start
        place = 0
        if kind == 2:
            self.level = self.at.imag
            while place < len(parts) and not self._follow_down(place, _DEEPEST):
                place += 1
            kind = _POCKETS_LEFT
        entry: int | None = place
        while entry is not None:
            entry = self._cut_pocket(entry, kind)

    def _count_turn(self) -> None:
        self.turns += 1
        if self.turns > self.tool.machine.budget.max_motions_per_block:
            raise ContourError("it needs too many cuts, or its contour cannot be followed; use a larger I")

    def _cut_pocket(self, place: int, kind: int) -> int | None:
        parts = self.tool.contour.parts
        self.level = self.begun[-1].imag
        while place < len(parts):
            self._count_turn()
            self._lower_level()
            if self._follow_down(place, self.level):
                return self._follow_contour(place, kind)
            if abs(self.at.imag - self.level) > _NEAR:
                place += 1  # this part ends above the level
                continue
            place = self._cut_pass(place)
        return None

    def _lower_level(self) -> None:
        above = self.level - _NEAR - self.at.imag
        if above > 1e6 * self.depth:
            raise ContourError("it needs too many cuts; use a larger I")
        while self.level - _NEAR > self.at.imag:
            self.level -= self.depth

    def _cut_pass(self, place: int) -> int:
        parts = self.tool.contour.parts
        for hit in range(place, len(parts)):
            found = parts[hit].find_crossings(self.at.imag)
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
            self.tool.feed_to(end)
            self.tool.move_rapid_to(end + share * self.escape)
            self.tool.move_rapid_to(self.at - (share * self.escape).conjugate())
            (self.tool.move_rapid_to if place == 0 else self.tool.feed_to)(self.at)
            self.level -= self.depth
            break
        return place

    def _follow_contour(self, place: int, kind: int) -> int | None:
        parts = self.tool.contour.parts
        for number in range(place, len(parts)):
            if kind == 1:
                self._climb_from_level(parts[number])
            elif self._climb_part(parts[number]):
                if kind == _POCKETS_LEFT:
                    self._begin_pocket()
                return number
        return None

    def _begin_pocket(self) -> None:
        if self.at.imag > self.begun[-1].imag and len(self.begun) > 1:
            self.begun.pop()
        if len(self.begun) == 1:
            self.begun.append(self.at)

    def _follow_down(self, place: int, x: float) -> bool:
        """Follow a part down to the height ``x``; True if it does not lead down."""
        part = self.tool.contour.parts[place]
        if part.centre is not None:
            return self._follow_arc_down(part, part.centre, x)
        if part.start.imag <= part.end.imag + _NEAR:
            return True
        end = part.end
        if not x < part.end.imag:
            found = part.find_crossings(x)
            if not found:
                raise ContourError("its contour begins below the start of the cut")
            end = complex(found[0], x)
        (self.tool.move_rapid_to if place == 0 else self.tool.feed_to)(end)
        self.at = end
        return False

    def _follow_arc_down(self, part: ContourPart, centre: complex, x: float) -> bool:
        ahead = (self.at - part.end).real
        if abs(self.at - part.end) < _NEAR or ahead <= _NEAR:
            self.at = part.end
            return False
        found = part.find_crossings(x) or part.find_crossings(x - _NEAR)
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
        self.tool.follow_part(part, end)
        self.at = end
        return False

    def _climb_part(self, part: ContourPart) -> bool:
        """Follow a part up; True if it does not lead up to its end."""
        if part.centre is None:
            if part.end.imag + _NEAR < part.start.imag:
                return True
            if abs(self.at - part.start) > _NEAR:
                raise ContourError("its contour has a gap")
            self.tool.feed_to(part.end)
            self.at = part.end
            return False
        behind = self.at.real < part.centre.real if part.ccw else self.at.real > part.centre.real
        if not behind:
            self._follow_arc_up(part)
        return behind or part.ccw

    def _climb_from_level(self, part: ContourPart) -> None:
        if part.centre is None and part.end.imag < part.start.imag:
            return
        found = part.find_crossings(self.at.imag)
        if not found:
            return
        z = found[0]
        if part.centre is not None:
            z = found[0] if part.ccw else found[-1]
            if (z < part.centre.real) if part.ccw else (z > part.centre.real):
                return
        self.at = complex(z, self.at.imag)
        self.tool.feed_to(self.at)
        if part.centre is None:
            self.tool.feed_to(part.end)
            self.at = part.end
        else:
            self._follow_arc_up(part)

    def _follow_arc_up(self, part: ContourPart) -> None:
        """Follow an arc to its end, or to its crest if it falls after that."""
        end = part.end
        assert part.centre is not None
        if part.ccw and end.real < part.centre.real:
            end = complex(part.centre.real, part.centre.imag + abs(part.start - part.centre))
        if abs(self.at - end) > _TOUCH:
            self.tool.follow_part(part, end)
        self.at = end
