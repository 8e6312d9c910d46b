"""The interpreter: executes blocks in the RS-274 order and yields motions.

Order within a block: feed mode, F, S, stored modes, spindle, dwell, plane, units, compensation, tool length,
co-ordinate system, path control, distance, motion. Simple blocks (G0 or G1 with X Y Z F) take an equivalent shortcut.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import deepcopy
from functools import partial
from pathlib import Path

from fdhil.errors import GcodeBudget, ProgramError
from fdhil.program import arcs, canned, lathe, modes, offsets, probing, roughing, splines, targets
from fdhil.program.budget import Budget
from fdhil.program.checks import CYCLES, check_machine_words, check_readers, one_reader_of_axes
from fdhil.program.commands import Command
from fdhil.program.expressions import now
from fdhil.program.flow import Flow
from fdhil.program.machine import Machine
from fdhil.program.modal import INDEX, Modal
from fdhil.program.motions import Feed, Motion, Rapid
from fdhil.program.parameters import Variables
from fdhil.program.source import Source
from fdhil.program.state import KeptModes, names_of, numbers_of
from fdhil.program.words import Block, Line, clean, read, without_number

_VALUE = r"([+-]?(?:\d++\.?\d*+|\.\d++))[ \t]*+"
_SIMPLE = re.compile(
    r"[ \t]*+(?:N\d++[ \t]*+)?+(?:G0?([01])(?![\d.])[ \t]*+)?+"
    rf"(?:X{_VALUE})?+(?:Y{_VALUE})?+(?:Z{_VALUE})?+(?:F{_VALUE})?+",
    re.IGNORECASE,
)
_STOPS = (2, 30)
_MOTION_ALONE = frozenset({"motion"})
_MACHINE_WORDS = frozenset("st$")


def interpret(
    source: Path | Iterable[str], budget: Budget | None = None, *, block_delete: bool = False
) -> Iterator[Motion]:
    """Yield the motions of an NC program in machine mm, line by line in constant memory.

    ``source`` is a file or any iterable of lines; subroutines in other files are searched next to the file. With
    ``block_delete`` lines that begin with "/" are skipped. ProgramError with line and word for invalid or unsupported
    words, and for exceeding ``budget``. Initial state: offsets 0, position 0, G21 G17 G90 G94 G91.1 G54.
    """
    return Interpreter(source, budget or Budget(), block_delete).run()


class Interpreter:
    """One run of one program."""

    def __init__(self, source: Path | Iterable[str], budget: Budget, block_delete: bool) -> None:
        self._budget = budget
        self._block_delete = block_delete
        self._plain = budget.dialect.plain
        self._machine = Machine(budget)
        modal = self._machine.modal
        modal.wrapped = frozenset(INDEX[axis.lower()] for axis in budget.dialect.wrapped_axes)
        first = Source(source, budget.max_line_chars)
        names = names_of(
            modal, lambda: self._flow.source.line, lambda: self._flow.depth, lambda: self._variables.returned
        )
        self._variables = Variables(budget.max_parameters, numbers_of(modal), names)
        self._variables.store(5220, 1.0)
        self._kept = KeptModes(modal, self._variables)
        self._flow = Flow(first, self._variables, budget, self._kept.returned, self._state)
        self._series = canned.Series()
        self._spline = splines.Series()
        self._nurbs = splines.Nurbs()
        self._orders = self._other_orders()
        self._known: dict[str, Command | Line] = {}
        self._blocks = self._again = 0
        self._empty_so_far = True
        self._percent = self._tool = self._ended = False
        self._pending_tool = 0.0

    @property
    def files(self) -> list[tuple[Path, str]]:
        """The files opened so far with their digests, the program first."""
        return self._flow.files

    def close(self) -> None:
        """Close the files; not needed once all motions were yielded."""
        self._flow.close()

    def run(self) -> Iterator[Motion]:
        """Yield the motions until the program ends."""
        machine = self._machine
        try:
            while not self._ended:
                found = self._next_line()
                if found is None:
                    self._check_end()
                    break
                raw, line = found
                motion = self._simple(raw, line) or self._line(raw, line)
                if motion is not None:
                    yield motion
                elif machine.out:
                    ordered, machine.out = machine.out, []
                    if self._flow.repeating:
                        self._again += len(ordered) - 1
                    yield from ordered
            machine.end_compensation()
            yield from machine.out
        finally:
            self._flow.close()

    def _next_line(self) -> tuple[str, int] | None:
        """Return the next line to execute and its number, None after the last one; skipped lines are counted too."""
        flow = self._flow
        while True:
            raw = flow.source.next(flow.repeating)
            if raw is None:
                flow.at_end()
                return None
            line = flow.source.line
            self._count(raw, line)
            if not flow.skipping:
                return raw, line
            self._variables.line = line
            flow.skip_over(raw, line)

    def _count(self, raw: str, line: int) -> None:
        self._blocks += 1
        if self._blocks > self._budget.max_blocks:
            what = f"more than {self._budget.max_blocks} blocks were executed; if that is intended,"
            what += " raise max_blocks ([nc], or --max-blocks)"
            raise GcodeBudget(line, raw.strip()[:24], what)
        if self._flow.repeating:
            self._again += 1
            if self._again > self._budget.max_repeated_blocks:
                what = f"more than {self._budget.max_repeated_blocks} blocks were executed again; is a loop endless?"
                what += " If not, raise max_repeated_blocks ([nc], or --max-repeated-blocks)"
                raise GcodeBudget(line, raw.strip()[:24], what)

    def _state(self) -> object:
        """Return a copy of everything that the program has changed so far, except its position."""
        kept = (self._machine, self._series, self._spline, self._nurbs, self._pending_tool, self._tool)
        return self._variables.state(), self._kept.state(), deepcopy(kept)

    def _simple(self, raw: str, line: int) -> Motion | None:
        match = _SIMPLE.fullmatch(raw) if self._plain else None
        if match is None:
            return None
        g, x, y, z, f = match.groups()
        return self._straight(
            line,
            10 * int(g) if g else None,
            float(x) if x else None,
            float(y) if y else None,
            float(z) if z else None,
            float(f) if f else None,
        )

    def _straight(
        self, line: int, code: int | None, x: float | None, y: float | None, z: float | None, f: float | None
    ) -> Motion | None:
        """Execute a block of G0 or G1 (times ten), X, Y, Z and F; return None, without effect, if it is not simple."""
        modal = self._machine.modal
        motion = modal.motion if code is None else code
        if motion not in (0, 10) or not modal.plain or self._nurbs.points or (x is None and y is None and z is None):
            return None
        feed = modal.feed_mm_min if f is None else f * modal.scale
        if not 0.0 <= feed < math.inf or (motion == 10 and feed == 0.0):
            return None
        position = list(modal.position)
        for index, word in ((0, x), (1, y), (2, z)):
            if word is not None:
                value = word * modal.scale
                position[index] = value if modal.absolute else position[index] + value
        end = modal.machine(position)
        limit = self._budget.max_coordinate_mm
        if not (abs(end[0]) <= limit and abs(end[1]) <= limit and abs(end[2]) <= limit):
            return None
        if f is not None:
            modal.feed_word, modal.feed_mm_min = f, feed
        self._empty_so_far = False
        modal.motion = motion
        modal.position = position
        self._spline.leaving = None
        self._series.began = None
        self._machine.just_left = False
        corner = modal.corner
        return Rapid(line, end, corner) if motion == 0 else Feed(line, end, feed, corner)

    def _line(self, raw: str, line: int) -> Motion | None:
        known = self._fetch(raw, line)
        if known is None:
            return None
        if known.straight is not None and self._plain:
            x, y, z, f = (None if value is None else now(value) for value in known.straight)
            motion = self._straight(line, known.code, x, y, z, f)
            if motion is not None:
                return motion
        if known.words or known.fixed is not None:
            block = self._block(known)
            if "call" in block.m:
                check_readers(block, None)
                self._ended = not self._flow.call_or_end(block, without_number(clean(raw, line).lstrip("/")))
                return None
            self._execute(block)
            self._settle(block.settings, line)
        else:
            self._settle(known.values(self._variables), line)
        return None

    def _block(self, known: Line) -> Block:
        """Return the block of a line at present, with its numbers as the dialect reads them."""
        return self._budget.dialect.read(known.block(self._variables), self._machine.modal)

    def _fetch(self, raw: str, line: int) -> Line | None:
        """Return a parsed line, None if it has no words; an O-word is executed."""
        self._variables.line = line
        known = self._known.get(raw)
        if known is None:
            known = self._read(raw, line)
            if known is None:
                return None
            if self._flow.repeats:
                if len(self._known) >= self._budget.max_kept_lines:
                    self._known.clear()
                self._known[raw] = known
        if isinstance(known, Command):
            self._flow.execute(known, line)
            return None
        return known

    def _settle(self, settings: list[tuple[int | str, float]], line: int) -> None:
        for key, value in settings:
            self._variables.set(key, value, line)

    def _read(self, raw: str, line: int) -> Command | Line | None:
        if raw.strip() == "%":
            self._at_percent(line)
            return None
        text = clean(raw, line)
        self._empty_so_far = self._empty_so_far and not raw.strip()
        if text.startswith("/"):
            text = "" if self._block_delete else text[1:]
        if not text:
            return None
        text = without_number(text)
        if text.startswith("o"):
            return self._flow.read(text)
        return read(text, self._variables, self._budget.max_nesting)

    def _check_end(self) -> None:
        line = max(1, self._flow.source.line)
        if self._percent:
            raise ProgramError(line, "%", "the program begins with % but does not end with it; add % or M2")
        if self._empty_so_far:
            raise ProgramError(line, "", "the program is empty; use one with at least one block")

    def _at_percent(self, line: int) -> None:
        if self._empty_so_far:
            self._percent, self._empty_so_far = True, False
        elif self._percent or self._flow.depth:
            self._ended = True
        else:
            raise ProgramError(line, "%", "must enclose the program; add it before the first block")

    def _execute(self, block: Block) -> None:
        machine, modal = self._machine, self._machine.modal
        if machine.compensation is not None:
            modes.check_compensated(modal, block)
            if "stop" in block.m or "tool" in block.m:
                machine.settle()
        check_readers(block, _motion_of(modal, block))
        if not block.m and block.g.keys() <= _MOTION_ALONE and block.words.keys().isdisjoint(_MACHINE_WORDS):
            modes.set_feed(modal, block)
            self._motion(block, False)
            return
        one_reader_of_axes(block)
        check_machine_words(block)
        modes.set_feed(modal, block)
        modes.set_spindle(modal, block)
        modes.set_switches(modal, block)
        self._change_tool(block)
        if "modal state" in block.m and not self._kept.do(block.m["modal state"], self._flow.depth):
            raise block.fault("M72", "has no modes to restore; save them by M70 first")
        if block.g.get("one-shot") == 40:
            modes.dwell(machine, block)
        modes.set_units(modal, block)
        self._coordinates(block)
        modes.set_distance(modal, block)
        self._motion(block, self._set(block))
        self._ended = self._ended or block.m.get("stop") in _STOPS

    def _change_tool(self, block: Block) -> None:
        self._pending_tool = block.words.get("t", self._pending_tool)
        if block.m.get("tool") == 6:
            self._tool = self._pending_tool != 0.0
        elif block.m.get("tool") == 61:
            self._tool = block.words.get("q", 0.0) != 0.0

    def _coordinates(self, block: Block) -> None:
        modal, g = self._machine.modal, block.g
        if "cutter compensation" in g:
            modes.compensate(self._machine, block, self._tool)
        if "tool length" in g:
            offsets.set_tool_length(modal, block)
        if "co-ordinate system" in g:
            offsets.select_system(modal, self._variables, offsets.SYSTEMS[g["co-ordinate system"]])

    def _set(self, block: Block) -> bool:
        """Execute a one-shot code; return True if it uses the axis words."""
        modal, variables = self._machine.modal, self._variables
        code = block.g.get("one-shot", 40)
        if code in (281, 301):
            offsets.store_home(modal, variables, code)
        elif code in (921, 922, 923):
            offsets.drop_g92(modal, variables, code)
        elif code == 100:
            offsets.set_data(modal, variables, block)
        elif code in (920, 520):
            offsets.set_g92(modal, variables, block)
        elif code in (280, 300):
            offsets.go_home(self._machine, variables, block)
        return code in (100, 920, 520, 280, 300) or block.g.get("tool length") == 431

    def _motion(self, block: Block, axes_used: bool) -> None:
        machine, modal = self._machine, self._machine.modal
        axis = targets.axis_letter(block)
        before = modal.motion
        if "motion" in block.g:
            modal.motion = block.g["motion"]
        elif "machine co-ordinates" in block.g and modal.motion not in (0, 10):
            raise block.fault("G53", "needs G0 or G1")
        elif axes_used or _motion_of(modal, block) is None:
            return
        code = modal.motion
        if code not in CYCLES:
            self._series.began = None
        if code not in splines.BEZIER_CODES:
            self._spline.leaving = None
        if code not in (splines.NURBS_BEGIN, splines.NURBS_END):
            self._nurbs.points.clear()
        if code in roughing.CODES:
            self._work_contour(block, before)
        elif code in CYCLES:
            canned.cycle(machine, block, self._series, before != code)
        elif code in self._orders:
            self._orders[code](block)
        elif axis is not None and not axes_used:
            raise block.fault(axis, "has no motion code; use G0, G1, G2 or G3")

    def _other_orders(self) -> Mapping[int, Callable[[Block], None]]:
        machine, modal = self._machine, self._machine.modal
        return {
            0: lambda block: machine.rapid_to(block, targets.target(modal, block)),
            10: lambda block: machine.feed_to(block, targets.target(modal, block)),
            **dict.fromkeys(arcs.CODES, partial(arcs.arc, machine)),
            **dict.fromkeys(probing.CODES, partial(probing.probe, machine, self._variables)),
            330: partial(lathe.synchronised, machine),
            331: partial(lathe.synchronised, machine),
            760: partial(lathe.threading, machine),
            **dict.fromkeys(splines.BEZIER_CODES, partial(splines.spline, machine, self._spline)),
            splines.NURBS_BEGIN: partial(self._nurbs.gather, machine),
            splines.NURBS_END: partial(self._nurbs.order_motions, machine),
        }

    def _work_contour(self, block: Block, before: int) -> None:
        """G70 to G72.2: read the contour of subroutine Q without executing its blocks, and machine it."""
        modal, flow = self._machine.modal, self._flow
        start = roughing.start_of(self._machine, block)
        here = list(modal.position)
        flow.call_contour(block, str(round(block.words["q"])))
        contour = roughing.Drawn(modal, before, start)
        depth = flow.depth
        while flow.depth >= depth:
            found = self._next_line()
            if found is None:
                break
            raw, line = found
            known = self._fetch(raw, line)
            if known is not None:
                drawn = self._block(known)
                contour.add(drawn)
                self._settle(drawn.settings, line)
        modal.position = here
        roughing.work(self._machine, block, contour, start)
        modal.motion = contour.motion


def _motion_of(modal: Modal, block: Block) -> int | None:
    """Return the motion code of the block, or the active one if the block has words for it."""
    if "motion" in block.g:
        return block.g["motion"]
    arc = modal.motion in arcs.CODES and any(letter in block.words for letter in "ijkr")
    return modal.motion if arc or targets.axis_letter(block) is not None else None
