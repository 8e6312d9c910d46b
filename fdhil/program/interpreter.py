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
from fdhil.program import (
    arcs,
    block_modes,
    canned_cycles,
    coordinate_systems,
    lathe,
    probing,
    roughing,
    splines,
    targets,
)
from fdhil.program.budget import Budget
from fdhil.program.expressions import evaluate_value
from fdhil.program.modal_state import INDEX, ModalState
from fdhil.program.motion_builder import MotionBuilder
from fdhil.program.motions import Feed, Motion, Rapid
from fdhil.program.o_words import OWordCommand
from fdhil.program.parameters import ProgramVariables
from fdhil.program.program_flow import ProgramFlow
from fdhil.program.program_source import ProgramSource
from fdhil.program.readable_state import SavedModes, build_named_readings, build_numbered_readings
from fdhil.program.word_checks import CYCLES, check_machine_words, check_word_usage, require_single_axis_code
from fdhil.program.words import Block, ParsedLine, clean_line, parse_line, remove_line_number

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
        self._plain = budget.dialect.is_plain
        self._machine = MotionBuilder(budget)
        modal = self._machine.modal
        modal.wrapped = frozenset(INDEX[axis.lower()] for axis in budget.dialect.wrapped_axes)
        first = ProgramSource(source, budget.max_line_chars)
        names = build_named_readings(
            modal, lambda: self._flow.source.line, lambda: self._flow.depth, lambda: self._variables.returned
        )
        self._variables = ProgramVariables(budget.max_parameters, build_numbered_readings(modal), names)
        self._variables.store_number(5220, 1.0)
        self._kept = SavedModes(modal, self._variables)
        self._flow = ProgramFlow(first, self._variables, budget, self._kept.end_call, self._copy_state)
        self._series = canned_cycles.CycleSeries()
        self._spline = splines.SplineSeries()
        self._nurbs = splines.NurbsCurve()
        self._orders = self._build_motion_orders()
        self._known: dict[str, OWordCommand | ParsedLine] = {}
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
                found = self._read_next_line()
                if found is None:
                    self._check_end()
                    break
                raw, line = found
                motion = self._execute_simple_block(raw, line) or self._execute_line(raw, line)
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

    def _read_next_line(self) -> tuple[str, int] | None:
        """Return the next line to execute and its number, None after the last one; skipped lines are counted too."""
        flow = self._flow
        while True:
            raw = flow.source.read_next_line(flow.repeating)
            if raw is None:
                flow.check_at_end()
                return None
            line = flow.source.line
            self._count_block(raw, line)
            if not flow.is_skipping:
                return raw, line
            self._variables.line = line
            flow.skip_line(raw, line)

    def _count_block(self, raw: str, line: int) -> None:
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

    def _copy_state(self) -> object:
        """Return a copy of everything that the program has changed so far, except its position."""
        kept = (self._machine, self._series, self._spline, self._nurbs, self._pending_tool, self._tool)
        return self._variables.copy_state(), self._kept.copy_state(), deepcopy(kept)

    def _execute_simple_block(self, raw: str, line: int) -> Motion | None:
        match = _SIMPLE.fullmatch(raw) if self._plain else None
        if match is None:
            return None
        g, x, y, z, f = match.groups()
        return self._execute_straight_move(
            line,
            10 * int(g) if g else None,
            float(x) if x else None,
            float(y) if y else None,
            float(z) if z else None,
            float(f) if f else None,
        )

    def _execute_straight_move(
        self, line: int, code: int | None, x: float | None, y: float | None, z: float | None, f: float | None
    ) -> Motion | None:
        """Execute a block of G0 or G1 (times ten), X, Y, Z and F; return None, without effect, if it is not simple."""
        modal = self._machine.modal
        motion = modal.motion if code is None else code
        if motion not in (0, 10) or not modal.is_plain or self._nurbs.points or (x is None and y is None and z is None):
            return None
        feed = modal.feed_mm_min if f is None else f * modal.scale
        if not 0.0 <= feed < math.inf or (motion == 10 and feed == 0.0):
            return None
        position = list(modal.position)
        for index, word in ((0, x), (1, y), (2, z)):
            if word is not None:
                value = word * modal.scale
                position[index] = value if modal.absolute else position[index] + value
        end = modal.convert_to_machine(position)
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

    def _execute_line(self, raw: str, line: int) -> Motion | None:
        known = self._fetch_line(raw, line)
        if known is None:
            return None
        if known.straight is not None and self._plain:
            x, y, z, f = (None if value is None else evaluate_value(value) for value in known.straight)
            motion = self._execute_straight_move(line, known.code, x, y, z, f)
            if motion is not None:
                return motion
        if known.words or known.fixed is not None:
            block = self._evaluate_block(known)
            if "call" in block.m:
                check_word_usage(block, None)
                self._ended = not self._flow.call_or_end(block, remove_line_number(clean_line(raw, line).lstrip("/")))
                return None
            self._execute_block(block)
            self._store_settings(block.settings, line)
        else:
            self._store_settings(known.evaluate_settings(self._variables), line)
        return None

    def _evaluate_block(self, known: ParsedLine) -> Block:
        """Return the block of a line at present, with its numbers as the dialect reads them."""
        return self._budget.dialect.scale_block(known.evaluate_block(self._variables), self._machine.modal)

    def _fetch_line(self, raw: str, line: int) -> ParsedLine | None:
        """Return a parsed line, None if it has no words; an O-word is executed."""
        self._variables.line = line
        known = self._known.get(raw)
        if known is None:
            known = self._parse_line(raw, line)
            if known is None:
                return None
            if self._flow.repeats:
                if len(self._known) >= self._budget.max_kept_lines:
                    self._known.clear()
                self._known[raw] = known
        if isinstance(known, OWordCommand):
            self._flow.execute_command(known, line)
            return None
        return known

    def _store_settings(self, settings: list[tuple[int | str, float]], line: int) -> None:
        for key, value in settings:
            self._variables.set_parameter(key, value, line)

    def _parse_line(self, raw: str, line: int) -> OWordCommand | ParsedLine | None:
        if raw.strip() == "%":
            self._process_percent(line)
            return None
        text = clean_line(raw, line)
        self._empty_so_far = self._empty_so_far and not raw.strip()
        if text.startswith("/"):
            text = "" if self._block_delete else text[1:]
        if not text:
            return None
        text = remove_line_number(text)
        if text.startswith("o"):
            return self._flow.read_command(text)
        return parse_line(text, self._variables, self._budget.max_nesting)

    def _check_end(self) -> None:
        line = max(1, self._flow.source.line)
        if self._percent:
            raise ProgramError(line, "%", "the program begins with % but does not end with it; add % or M2")
        if self._empty_so_far:
            raise ProgramError(line, "", "the program is empty; use one with at least one block")

    def _process_percent(self, line: int) -> None:
        if self._empty_so_far:
            self._percent, self._empty_so_far = True, False
        elif self._percent or self._flow.depth:
            self._ended = True
        else:
            raise ProgramError(line, "%", "must enclose the program; add it before the first block")

    def _execute_block(self, block: Block) -> None:
        machine, modal = self._machine, self._machine.modal
        if machine.compensation is not None:
            block_modes.check_compensated(modal, block)
            if "stop" in block.m or "tool" in block.m:
                machine.settle_compensation()
        check_word_usage(block, _determine_motion(modal, block))
        if not block.m and block.g.keys() <= _MOTION_ALONE and block.words.keys().isdisjoint(_MACHINE_WORDS):
            block_modes.set_feed(modal, block)
            self._execute_motion(block, False)
            return
        require_single_axis_code(block)
        check_machine_words(block)
        block_modes.set_feed(modal, block)
        block_modes.set_spindle(modal, block)
        block_modes.set_switches(modal, block)
        self._change_tool(block)
        if "modal state" in block.m and not self._kept.execute_code(block.m["modal state"], self._flow.depth):
            raise block.build_error("M72", "has no modes to restore; save them by M70 first")
        if block.g.get("one-shot") == 40:
            block_modes.order_dwell(machine, block)
        block_modes.set_units(modal, block)
        self._set_coordinates(block)
        block_modes.set_distance(modal, block)
        self._execute_motion(block, self._execute_one_shot(block))
        self._ended = self._ended or block.m.get("stop") in _STOPS

    def _change_tool(self, block: Block) -> None:
        self._pending_tool = block.words.get("t", self._pending_tool)
        if block.m.get("tool") == 6:
            self._tool = self._pending_tool != 0.0
        elif block.m.get("tool") == 61:
            self._tool = block.words.get("q", 0.0) != 0.0

    def _set_coordinates(self, block: Block) -> None:
        modal, g = self._machine.modal, block.g
        if "cutter compensation" in g:
            block_modes.switch_compensation(self._machine, block, self._tool)
        if "tool length" in g:
            coordinate_systems.set_tool_length(modal, block)
        if "co-ordinate system" in g:
            coordinate_systems.select_system(
                modal, self._variables, coordinate_systems.SYSTEMS[g["co-ordinate system"]]
            )

    def _execute_one_shot(self, block: Block) -> bool:
        """Execute a one-shot code; return True if it uses the axis words."""
        modal, variables = self._machine.modal, self._variables
        code = block.g.get("one-shot", 40)
        if code in (281, 301):
            coordinate_systems.store_home(modal, variables, code)
        elif code in (921, 922, 923):
            coordinate_systems.drop_g92(modal, variables, code)
        elif code == 100:
            coordinate_systems.set_system_data(modal, variables, block)
        elif code in (920, 520):
            coordinate_systems.set_g92(modal, variables, block)
        elif code in (280, 300):
            coordinate_systems.go_home(self._machine, variables, block)
        return code in (100, 920, 520, 280, 300) or block.g.get("tool length") == 431

    def _execute_motion(self, block: Block, axes_used: bool) -> None:
        machine, modal = self._machine, self._machine.modal
        axis = targets.find_axis_letter(block)
        before = modal.motion
        if "motion" in block.g:
            modal.motion = block.g["motion"]
        elif "machine co-ordinates" in block.g and modal.motion not in (0, 10):
            raise block.build_error("G53", "needs G0 or G1")
        elif axes_used or _determine_motion(modal, block) is None:
            return
        code = modal.motion
        if code not in CYCLES:
            self._series.began = None
        if code not in splines.BEZIER_CODES:
            self._spline.leaving = None
        if code not in (splines.NURBS_BEGIN, splines.NURBS_END):
            self._nurbs.points.clear()
        if code in roughing.CODES:
            self._execute_contour_cycle(block, before)
        elif code in CYCLES:
            canned_cycles.order_canned_cycle(machine, block, self._series, before != code)
        elif code in self._orders:
            self._orders[code](block)
        elif axis is not None and not axes_used:
            raise block.build_error(axis, "has no motion code; use G0, G1, G2 or G3")

    def _build_motion_orders(self) -> Mapping[int, Callable[[Block], None]]:
        machine, modal = self._machine, self._machine.modal
        return {
            0: lambda block: machine.move_rapid_to(block, targets.compute_target(modal, block)),
            10: lambda block: machine.feed_to(block, targets.compute_target(modal, block)),
            **dict.fromkeys(arcs.CODES, partial(arcs.order_arc, machine)),
            **dict.fromkeys(probing.CODES, partial(probing.order_probe_move, machine, self._variables)),
            330: partial(lathe.order_synchronised_feed, machine),
            331: partial(lathe.order_synchronised_feed, machine),
            760: partial(lathe.order_threading_cycle, machine),
            **dict.fromkeys(splines.BEZIER_CODES, partial(splines.order_spline, machine, self._spline)),
            splines.NURBS_BEGIN: partial(self._nurbs.gather_point, machine),
            splines.NURBS_END: partial(self._nurbs.order_motions, machine),
        }

    def _execute_contour_cycle(self, block: Block, before: int) -> None:
        """G70 to G72.2: read the contour of subroutine Q without executing its blocks, and machine it."""
        modal, flow = self._machine.modal, self._flow
        start = roughing.move_to_start(self._machine, block)
        here = list(modal.position)
        flow.call_contour(block, str(round(block.words["q"])))
        contour = roughing.DrawnContour(modal, before, start)
        depth = flow.depth
        while flow.depth >= depth:
            found = self._read_next_line()
            if found is None:
                break
            raw, line = found
            known = self._fetch_line(raw, line)
            if known is not None:
                drawn = self._evaluate_block(known)
                contour.add_block(drawn)
                self._store_settings(drawn.settings, line)
        modal.position = here
        roughing.order_contour_cycle(self._machine, block, contour, start)
        modal.motion = contour.motion


def _determine_motion(modal: ModalState, block: Block) -> int | None:
    """Return the motion code of the block, or the active one if the block has words for it."""
    if "motion" in block.g:
        return block.g["motion"]
    arc = modal.motion in arcs.CODES and any(letter in block.words for letter in "ijkr")
    return modal.motion if arc or targets.find_axis_letter(block) is not None else None
