"""The modal state of the interpreter: position, co-ordinates, units, plane and modes.

Lengths are millimetres and angles degrees throughout; ``scale`` is one program unit of length in mm. Positions have
nine entries in the order X Y Z A B C U V W.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fdhil.program.motions import BLEND, PLANES, Corner, Point
from fdhil.program.words import format_g_word

AXES = "xyzabcuvw"
INDEX = {letter: place for place, letter in enumerate(AXES)}
LINEAR = frozenset("xyzuvw")
MM_PER_INCH = 25.4
NO_MOTION = 800  # G80
PLANE_CODES = (170, 180, 190, 171, 181, 191)  # times ten; the last three are planes of U V W, which fdhil does not list
_EXACT = {610: Corner("exact_path", 0.0), 611: Corner("exact_stop", 0.0)}


def _make_zeros() -> list[float]:
    return [0.0] * 9


@dataclass(slots=True)
class ModalState:
    """State that one block leaves to the next; the defaults are those of a program's start.

    ``position`` is the controlled point in active co-ordinates. Machine co-ordinates result from adding ``g92``,
    rotating about Z by ``rotation_deg`` and adding ``g5x``; ``tool`` is the tool's length between it and the axes.
    """

    position: list[float] = field(default_factory=_make_zeros)
    g5x: list[float] = field(default_factory=_make_zeros)
    g92: list[float] = field(default_factory=_make_zeros)
    tool: list[float] = field(default_factory=_make_zeros)
    rotation_deg: float = 0.0
    system: int = 1
    scale: float = 1.0
    plane: int = 0
    absolute: bool = True
    arc_absolute: bool = False
    diameter: bool = False
    motion: int = NO_MOTION
    feed_mode: int = 940
    feed_word: float = 0.0
    feed_mm_min: float = 0.0
    spindle_rpm: float = 0.0
    spindle_turns: int = 0
    surface_speed: bool = False
    flood: bool = False
    mist: bool = False
    feed_override: bool = True
    speed_override: bool = True
    adaptive_feed: bool = False
    feed_hold: bool = True
    retract_to_r: bool = True
    compensation: int = 400
    path_control: int = 640
    path_tolerance_mm: float = 0.0
    joining_mm: float = 0.0
    wrapped: frozenset[int] = frozenset()  # rotary axes with absolute words within one turn

    @property
    def is_plain(self) -> bool:
        """Whether a straight move needs no more than adding offsets: G94, radius, no cutter compensation."""
        return self.feed_mode == 940 and self.compensation == 400 and not self.diameter

    @property
    def corner(self) -> Corner:
        """How the path may leave the end of the current motion, by the active path control."""
        if self.path_control != 640:
            return _EXACT[self.path_control]
        if not (self.path_tolerance_mm > 0.0 or self.joining_mm > 0.0):
            return BLEND
        return Corner("blend", self.path_tolerance_mm or math.inf, self.joining_mm)

    @property
    def code(self) -> str:
        """The motion in force in program notation: G38.2."""
        return format_g_word(self.motion)

    @property
    def plane_name(self) -> str:
        """XY, XZ, YZ, UV, UW or VW."""
        return (*PLANES, "UV", "UW", "VW")[self.plane]

    def get_unit(self, index: int) -> float:
        """Return one program unit of an axis in mm or degrees."""
        return self.scale if AXES[index] in LINEAR else 1.0

    def convert_to_machine(self, position: list[float] | None = None) -> Point:
        """Return X, Y, Z of a position (default: the present one) in machine millimetres."""
        p = self.position if position is None else position
        x, y, z = p[0] + self.g92[0], p[1] + self.g92[1], p[2] + self.g92[2]
        if self.rotation_deg:
            x, y = rotate_point(x, y, self.rotation_deg)
        return (x + self.g5x[0], y + self.g5x[1], z + self.g5x[2])

    def convert_all_to_machine(self) -> list[float]:
        """Return all nine axes of the controlled point in machine co-ordinates."""
        return [*self.convert_to_machine(), *self.convert_others_to_machine(self.position)]

    def convert_others_to_machine(self, position: list[float]) -> list[float]:
        """Return A B C (degrees) U V W (mm) of a position in machine co-ordinates."""
        return [p + o + g for p, o, g in zip(position[3:], self.g92[3:], self.g5x[3:], strict=True)]

    def convert_from_machine(self, machine: list[float]) -> list[float]:
        """Return the active co-ordinates of a controlled point in machine co-ordinates."""
        moved = [m - g for m, g in zip(machine, self.g5x, strict=True)]
        if self.rotation_deg:
            moved[0], moved[1] = rotate_point(moved[0], moved[1], -self.rotation_deg)
        return [m - o for m, o in zip(moved, self.g92, strict=True)]


def rotate_point(x: float, y: float, degrees: float) -> tuple[float, float]:
    """Rotate a point about the origin, counter-clockwise."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return x * c - y * s, x * s + y * c
