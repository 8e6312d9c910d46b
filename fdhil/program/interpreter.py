"""The interpreter: blocks in the order of execution that RS-274 wants, motions out.

A block is executed feed mode, F, S, tool, spindle, dwell, plane, units, compensation, offsets, path control, distance,
and its motion last. Simple blocks (G0 or G1 with X Y Z F) take a short way with the same meaning.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from fdhil.errors import ProgramError
from fdhil.program import arcs, moves, offsets
from fdhil.program.budget import Budget
from fdhil.program.modal import INDEX, MM_PER_INCH, NO_MOTION, Modal
from fdhil.program.motions import Feed, Motion, Rapid
from fdhil.program.parameters import Variables
from fdhil.program.source import Source
from fdhil.program.words import Block, clean, read

_VALUE = r"([+-]?(?:\d++\.?\d*+|\.\d++))[ \t]*+"
_SIMPLE = re.compile(
    r"[ \t]*+(?:N\d++[ \t]*+)?+(?:G0?([01])(?![\d.])[ \t]*+)?+"
    rf"(?:X{_VALUE})?+(?:Y{_VALUE})?+(?:Z{_VALUE})?+(?:F{_VALUE})?+",
    re.IGNORECASE,
)
_STOPS = (2, 30)
ARC_MOTIONS = (20, 30)


def interpret(source: Path | Iterable[str], budget: Budget | None = None) -> Iterator[Motion]:
    """Yield the motions of an NC program in machine mm, line by line in flat memory.

    ``source`` is a file or any iterable of lines. ProgramError with line and word for what is wrong, for what fdhil
    does not know, and for what exceeds ``budget``. Start: offsets 0, position 0, G21 G17 G90 G94 G91.1 G54.
    """
    return Interpreter(source, budget or Budget()).run()


class Interpreter:
    """One run of one program."""

    def __init__(self, source: Path | Iterable[str], budget: Budget) -> None:
        self._budget = budget
        self._source = Source(source, budget.max_line_chars)
        self._machine = moves.Machine(budget)
        modal = self._machine.modal
        self._variables = Variables(budget.max_parameters, _state_numbers(modal), _state_names(modal))
        self._blocks = 0
        self._ended = False

    def run(self) -> Iterator[Motion]:
        """Yield the motions until the program ends."""
        source, machine = self._source, self._machine
        try:
            while not self._ended:
                raw = source.next()
                if raw is None:
                    return
                self._count(source.line)
                motion = self._simple(raw, source.line)
                if motion is not None:
                    yield motion
                    continue
                self._line(raw, source.line)
                if machine.out:
                    ordered, machine.out = machine.out, []
                    yield from ordered
        finally:
            source.close()

    def _count(self, line: int) -> None:
        self._blocks += 1
        if self._blocks > self._budget.max_blocks:
            raise ProgramError(
                line, "", f"more than {self._budget.max_blocks} blocks were executed; is a loop endless?"
            )

    def _simple(self, raw: str, line: int) -> Motion | None:
        """Execute a block of G0, G1, X, Y, Z, F alone; None leaves it to the long way."""
        match = _SIMPLE.fullmatch(raw)
        if match is None:
            return None
        g, x, y, z, f = match.groups()
        modal = self._machine.modal
        motion = modal.motion if g is None else 10 * int(g)
        if motion not in (0, 10) or modal.feed_mode != 940 or modal.diameter or (x is None and y is None and z is None):
            return None
        position = list(modal.position)
        for index, word in ((0, x), (1, y), (2, z)):
            if word is not None:
                value = float(word) * modal.scale
                position[index] = value if modal.absolute else position[index] + value
        end = modal.machine(position)
        limit = self._budget.max_coordinate_mm
        if not (abs(end[0]) <= limit and abs(end[1]) <= limit and abs(end[2]) <= limit):
            return None
        if f is not None:
            modal.feed_word = float(f)
            modal.feed_mm_min = modal.feed_word * modal.scale
        if motion == 10 and not 0.0 < modal.feed_mm_min < 1e300:
            return None
        modal.motion = motion
        modal.position = position
        return Rapid(line, end) if motion == 0 else Feed(line, end, modal.feed_mm_min)

    def _line(self, raw: str, line: int) -> None:
        text = clean(raw, line)
        if text.startswith("/"):
            text = text[1:]
        if not text:
            return
        if text.startswith("%"):
            self._ended = self._ended or line > 1
            return
        block = read(text, line, self._variables, self._budget.max_nesting)
        self._execute(block)
        for key, value in block.settings:
            self._variables.set(key, value, line)

    def _execute(self, block: Block) -> None:
        modal = self._machine.modal
        _feed_mode(modal, block)
        _spindle(modal, block)
        _modes(modal, block)
        self._coordinates(block)
        self._motion(block)
        self._ended = self._ended or block.m.get("stop") in _STOPS

    def _motion(self, block: Block) -> None:
        machine, modal = self._machine, self._machine.modal
        axes = any(letter in INDEX for letter in block.words)
        one_shot = block.g.get("one-shot")
        if one_shot == 40:
            self._dwell(block)
        elif one_shot is not None:
            axes = axes and not self._set(block, one_shot)
        if block.g.get("tool length") == 431:
            axes = False
        if "motion" in block.g:
            modal.motion = block.g["motion"]
        elif not axes:
            return
        if modal.motion == 0:
            if axes:
                machine.rapid_to(block, moves.target(modal, block))
        elif modal.motion == 10:
            if axes:
                machine.feed_to(block, moves.target(modal, block))
        elif modal.motion in ARC_MOTIONS:
            arcs.arc(machine, block)
        elif modal.motion == NO_MOTION:
            if axes:
                letter = next(letter for letter in block.words if letter in INDEX)
                raise block.fault(letter, "has no motion to go with; give G0, G1, G2 or G3")
        else:
            raise _unknown(block, modal.motion)

    def _coordinates(self, block: Block) -> None:
        modal = self._machine.modal
        if "tool length" in block.g:
            offsets.set_tool_length(modal, block)
        if "co-ordinate system" in block.g:
            offsets.select_system(modal, self._variables, offsets.SYSTEMS[block.g["co-ordinate system"]])

    def _set(self, block: Block, code: int) -> bool:
        """Do a one-shot code; True when it is the one that uses the axis words."""
        modal, variables = self._machine.modal, self._variables
        if code in (281, 301):
            offsets.store_home(modal, variables, code)
            return False
        if code in (921, 922, 923):
            offsets.drop_g92(modal, variables, code)
            return False
        if code == 100:
            offsets.set_data(modal, variables, block)
        elif code in (920, 520):
            offsets.set_g92(modal, variables, block)
        else:
            offsets.go_home(self._machine, variables, block)
        return True

    def _dwell(self, block: Block) -> None:
        seconds = block.words.get("p")
        if seconds is None or seconds < 0.0:
            raise ProgramError(block.line, "G4", "a dwell wants its seconds as P, not negative")
        self._machine.dwell(block, seconds)


def _unknown(block: Block, code: int) -> ProgramError:
    return ProgramError(block.line, f"G{code / 10:g}", "is a G code that fdhil does not know; see the list of codes")


def _feed_mode(modal: Modal, block: Block) -> None:
    mode = block.g.get("feed mode")
    if mode is not None and mode != modal.feed_mode:
        modal.feed_mode = mode
        modal.feed_mm_min = modal.feed_word = 0.0
    if "f" in block.words:
        feed = block.words["f"]
        if feed < 0.0:
            raise block.fault("f", "is a negative feed rate")
        modal.feed_word = feed
        modal.feed_mm_min = feed * modal.scale


def _spindle(modal: Modal, block: Block) -> None:
    if "s" in block.words:
        if block.words["s"] < 0.0:
            raise block.fault("s", "is a negative spindle speed; M4 turns it backwards")
        modal.spindle_rpm = block.words["s"]
    if "spindle" in block.m:
        modal.spindle_turns = {3: 1, 4: -1}.get(block.m["spindle"], 0)


def _modes(modal: Modal, block: Block) -> None:
    g = block.g
    if "plane" in g:
        modal.plane = {170: 0, 180: 1, 190: 2}[g["plane"]]
    if "units" in g:
        modal.scale = MM_PER_INCH if g["units"] == 200 else 1.0
    if (
        g.get("lathe diameter", 80) != 80
        or g.get("cutter compensation", 400) != 400
        or g.get("tool length", 490) != 490
    ):
        code = next(g[group] for group in ("lathe diameter", "cutter compensation", "tool length") if group in g)
        raise _unknown(block, code)
    if "path control" in g:
        modal.path_control = g["path control"]
        modal.path_tolerance_mm = block.words.get("p", 0.0) * modal.scale
    if "distance" in g:
        modal.absolute = g["distance"] == 900
    if "arc distance" in g:
        modal.arc_absolute = g["arc distance"] == 901


def _state_numbers(modal: Modal) -> Mapping[int, Callable[[], float]]:
    def place(index: int) -> Callable[[], float]:
        return lambda: modal.position[index] / (modal.scale if index not in (3, 4, 5) else 1.0)

    return {5420 + index: place(index) for index in range(9)}


def _state_names(modal: Modal) -> Mapping[str, Callable[[], float]]:
    return {"_feed": lambda: modal.feed_word, "_x": lambda: modal.position[0] / modal.scale}
