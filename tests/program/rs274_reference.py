"""The reference interpreter as a separate program: ``rs274`` of LinuxCNC prints canonical calls, parsed as motions.

Its co-ordinates are those of the program: the offsets and the rotation it prints are added here. Four decimals.
"""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fdhil.program import Arc, AxisMove, Dwell, Feed, Motion, Probe, Rapid
from fdhil.program.motions import PLANE_AXES

CASES = Path(__file__).parent / "differential.txt"
RS274 = shutil.which("rs274")
# a line number of nine digits fills its column, so the call follows without a blank
_CALL = re.compile(r"^\s*\d+\s+N(?:\.+\s+|\s*\d+\s*)([A-Z0-9_]+)\((.*)\)\s*$")


@dataclass
class ReferenceAnswer:
    """The reference's motions up to the end or the error, and the error's text ("" for none)."""

    motions: list[Motion] = field(default_factory=list)
    error: str = ""


@dataclass
class _Canon:
    scale: float = 1.0
    g5x: list[float] = field(default_factory=lambda: [0.0] * 3)
    g92: list[float] = field(default_factory=lambda: [0.0] * 3)
    rotation: float = 0.0
    plane: str = "XY"
    feed: float = 0.0
    per_revolution: bool = False
    rpm: float = 0.0
    pitch: float = 0.0
    at: list[float] = field(default_factory=lambda: [0.0] * 3)
    abc_offset: dict[str, list[float]] = field(default_factory=lambda: {"g5x": [0.0] * 3, "g92": [0.0] * 3})
    abc: list[float] = field(default_factory=lambda: [0.0] * 3)
    motions: list[Motion] = field(default_factory=list)

    def machine(self, position: list[float]) -> tuple[float, float, float]:
        x, y, z = (p * self.scale + o for p, o in zip(position, self.g92, strict=True))
        c, s = math.cos(math.radians(self.rotation)), math.sin(math.radians(self.rotation))
        return (x * c - y * s + self.g5x[0], x * s + y * c + self.g5x[1], z + self.g5x[2])

    def mm_min(self) -> float:
        if self.pitch:
            return self.pitch * self.rpm
        return self.feed * (self.rpm if self.per_revolution else 1.0)

    def turned(self, values: list[float]) -> tuple[AxisMove, ...]:
        """Return A, B and C of a motion in machine degrees; the reference has no U, V and W."""
        before, shift = self.abc, self.abc_offset
        self.abc = [v + a + b for v, a, b in zip(values, shift["g5x"], shift["g92"], strict=False)]
        return tuple(AxisMove(*each) for each in zip("ABC", before, self.abc, strict=True))

    def straight(self, name: str, values: list[float]) -> None:
        self.at = values[:3]
        end, turned = self.machine(self.at), self.turned(values[3:6])
        if name == "STRAIGHT_TRAVERSE":
            self.motions.append(Rapid(0, end, rotary=turned))
        elif name == "STRAIGHT_PROBE":
            self.motions.append(Probe(0, end, self.mm_min(), rotary=turned))
        else:
            self.motions.append(Feed(0, end, self.mm_min(), rotary=turned))

    def tap(self, values: list[float]) -> None:
        self.motions.append(Feed(0, self.machine(values[:3]), self.mm_min()))
        self.motions.append(Feed(0, self.machine(self.at), math.nan))  # the return speed (I) is not reported

    def arc(self, values: list[float]) -> None:
        first, second, normal = PLANE_AXES[self.plane]
        centre = list(self.at)
        centre[first], centre[second] = values[2], values[3]
        self.at[first], self.at[second], self.at[normal] = values[0], values[1], values[5]
        shown: list[float | None] = list(self.machine(centre))
        shown[normal] = None
        about, turned = (shown[0], shown[1], shown[2]), self.turned(values[6:9])
        end = self.machine(self.at)
        self.motions.append(Arc(0, end, about, int(values[4]), self.plane, self.mm_min(), rotary=turned))

    def call(self, name: str, text: str) -> None:
        numbers: Callable[[], list[float]] = lambda: [float(v) for v in text.split(",")]  # noqa: E731
        if name in ("STRAIGHT_TRAVERSE", "STRAIGHT_FEED", "STRAIGHT_PROBE"):
            self.straight(name, numbers())
        elif name == "ARC_FEED":
            self.arc(numbers())
        elif name == "RIGID_TAP":
            self.tap(numbers())
        elif name == "DWELL":
            self.motions.append(Dwell(0, max(0.0, float(text))))  # a negative one ends at once
        elif name == "USE_LENGTH_UNITS":
            self.units(25.4 if "INCHES" in text else 1.0)
        elif name == "SET_G5X_OFFSET":
            self.g5x = [v * self.scale for v in numbers()[1:4]]
            self.abc_offset["g5x"] = numbers()[4:7]
        elif name == "SET_G92_OFFSET":
            self.g92 = [v * self.scale for v in numbers()[:3]]
            self.abc_offset["g92"] = numbers()[3:6]
        elif name == "SET_XY_ROTATION":
            self.rotation = float(text)
        elif name == "SELECT_PLANE":
            self.plane = text.removeprefix("CANON_PLANE_")
        elif name == "SET_FEED_RATE":
            self.feed = float(text) * self.scale
        elif name == "START_SPEED_FEED_SYNC":
            self.pitch = numbers()[0] * self.scale
        elif name == "STOP_SPEED_FEED_SYNCH":
            self.pitch = 0.0
        elif name == "SET_FEED_MODE":
            self.per_revolution = numbers()[1] == 1
        elif name == "SET_SPINDLE_SPEED":
            self.rpm = numbers()[1]

    def units(self, scale: float) -> None:
        self.at = [v * self.scale / scale for v in self.at]
        self.scale = scale


def run_reference(program: Path, limit_s: float = 20.0, ini: str = "") -> ReferenceAnswer:
    """Run the reference on a file and an INI of this text, with tools without length and no stored parameters.

    SubprocessError if it does not end in time, or crashes.
    """
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "tool.tbl").write_text("".join(f"T{n} P{n} Z0 D0\n" for n in range(1, 56)))
        (Path(folder) / "empty.var").touch()
        arguments = [str(RS274), "-t", f"{folder}/tool.tbl", "-v", f"{folder}/empty.var", "-g", "-n", "2"]
        if ini:
            (Path(folder) / "machine.ini").write_text(ini)
            arguments += ["-i", f"{folder}/machine.ini"]
        arguments.append(str(program.resolve()))
        done = subprocess.run(arguments, cwd=program.parent, capture_output=True, timeout=limit_s, check=False)
    if done.returncode < 0:
        raise subprocess.SubprocessError(f"the reference was ended by signal {-done.returncode}")
    canon = _Canon()
    for line in done.stdout.decode("latin-1").splitlines():
        match = _CALL.match(line)
        if match is not None:
            canon.call(match[1], match[2])
    lines = done.stderr.decode("latin-1").strip().splitlines()
    reported = [line for line in lines if line.strip() and not line.startswith("executing")]
    return ReferenceAnswer(canon.motions, "\n".join(reported) if done.returncode else "")


def read_cases() -> list[tuple[str, str]]:
    """Return the written programs, and why they differ ("" if they must not)."""
    found, why = [], ""
    for line in CASES.read_text("utf-8").splitlines():
        if line.startswith("~"):
            why = line[1:].strip()
        elif line and line != "#" and not line.startswith("# "):
            text = line.replace("|", "\n")
            ends = "M2" in text.upper() or "M30" in text.upper() or "%" in text
            found.append((text + ("\n" if ends else "\nM2\n"), why))
            why = ""
    return found


def find_difference(ours: list[Motion], theirs: list[Motion], tolerance_mm: float = 3e-4) -> str:
    """Return where two lists of motions first differ, "" if they agree within the reference's decimals."""
    abc: dict[str, float] = {}
    for number, (a, b) in enumerate(zip(ours, theirs, strict=False)):
        if type(a) is not type(b) or not _is_near(_parse_figures(a), _parse_figures(b), tolerance_mm):
            return f"motion {number}: {a} against {b}"
        if not isinstance(a, Dwell) and not isinstance(b, Dwell):
            abc |= {turned.axis: turned.end for turned in a.rotary}
            if any(abs(abc.get(turned.axis, 0.0) - turned.end) > tolerance_mm for turned in b.rotary):
                return f"motion {number}: {a} against {b}, with {abc}"
    if len(ours) != len(theirs):
        more = (ours if len(ours) > len(theirs) else theirs)[min(len(ours), len(theirs))]
        return f"{len(ours)} motions against {len(theirs)}; the first one more is {more}"
    return ""


def _parse_figures(motion: Motion) -> list[float]:
    if isinstance(motion, Dwell):
        return [motion.seconds]
    figures = list(motion.end)
    if isinstance(motion, Arc):
        figures += [
            *(-1e9 if v is None else v for v in motion.centre),
            motion.turns,
            ("XY", "XZ", "YZ").index(motion.plane),
        ]
    if not isinstance(motion, Rapid):
        figures.append(motion.feed)
    return figures


def _is_near(ours: list[float], theirs: list[float], tolerance: float) -> bool:
    return all(math.isnan(b) or abs(a - b) <= tolerance + 1e-6 * abs(b) for a, b in zip(ours, theirs, strict=True))
