"""Control flow of a program: O-words (sub, call, return, while, do, repeat, if) and Fanuc calls (M98, M99).

Nothing is compiled: a jump is a seek in the source, and lines that are not executed are skipped. A label belongs to its
subroutine; each call has its own labels, #1 to #30 and local names.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from fdhil.errors import GcodeBudget, ProgramError
from fdhil.program.budget import Budget
from fdhil.program.call_frames import CallFrame, FlowLabel, SkipTarget
from fdhil.program.expressions import is_whole
from fdhil.program.o_words import FANUC, OWordCommand
from fdhil.program.parameters import LOCAL_NUMBERS, ProgramVariables
from fdhil.program.program_source import ProgramSource, SourcePlace
from fdhil.program.words import Block, clean_line, remove_line_number

_MAYBE_O_WORD = re.compile(r"[\s/]*(?:n[\d.\s]*)?o", re.IGNORECASE)
_WITH_VALUES = ("call", "return", "endsub", "if", "elseif", "while", "repeat")
_FILE_NAME = re.compile(r"[\w+-][\w .+-]*")


class ProgramFlow:
    """Tracks the position of execution; ``on_return`` is called at the end of a call, ``state`` copies the state."""

    def __init__(
        self,
        source: ProgramSource,
        variables: ProgramVariables,
        budget: Budget,
        on_return: Callable[[int], None],
        state: Callable[[], object],
    ) -> None:
        self.source = source
        self._variables = variables
        self._budget = budget
        self._on_return = on_return
        self._state = state
        self._frames = [CallFrame("")]
        self._subs: dict[str, tuple[SourcePlace, bool]] = {}
        self._entered: set[str] = set()
        self._skip: SkipTarget | None = None
        self._entering = False
        self.repeats = False  # lines may be repeated, so that parsed lines are worth keeping
        self.repeating = False  # the current lines were executed before, in this loop or subroutine
        self._known: dict[str, OWordCommand] = {}
        self._folder = source.folder
        self._files: list[ProgramSource] = [source]

    @property
    def depth(self) -> int:
        """Number of active calls."""
        return len(self._frames) - 1

    @property
    def is_skipping(self) -> bool:
        """Whether lines are skipped."""
        return self._skip is not None

    @property
    def files(self) -> list[tuple[Path, str]]:
        """The files opened so far with their digests, the program first."""
        return [(source.folder / source.name, source.sha256) for source in self._files if source.folder is not None]

    def close(self) -> None:
        """Close every open source."""
        for source in self._files:
            source.close()

    def check_at_end(self) -> None:
        """Check that the program may end here; ProgramError if a label is still searched or a call is active."""
        if self._skip is not None:
            if self._skip.keywords == (FANUC,):
                raise ProgramError(
                    self._skip.line, f"O{self._skip.label}", "is called but does not exist; add that block"
                )
            wanted = " or ".join(self._skip.keywords)
            raise ProgramError(self._skip.line, f"O<{self._skip.label}>", f"the program ends before its {wanted}")
        if self.depth:
            name = self._frames[-1].name
            raise ProgramError(self.source.line, f"O<{name}>", "the file ends within the subroutine; add its endsub")

    def skip_line(self, raw: str, line: int) -> None:
        """Check a skipped line: it may be the one that is searched."""
        if _MAYBE_O_WORD.match(raw) is None:
            return
        command = self._known.get(raw)
        if command is None:
            text = remove_line_number(clean_line(raw, line).lstrip("/"))
            if not text.startswith("o"):
                return
            command = self._known[raw] = self.read_command(text)
            if len(self._known) > self._budget.max_kept_lines:
                self._known.clear()
        label, skip = command.evaluate_label(), self._skip
        if command.keyword == "sub" and skip is not None and skip.keywords == ("endsub",):
            raise command.build_error(f"begins within the subroutine O<{skip.label}>; move it out")
        if skip is None or label != skip.label or command.keyword not in skip.keywords:
            return
        self._skip = None
        if self._entering:
            self._begin_subroutine(label, command.keyword)
        elif skip.execute:
            self.execute_command(command, line)

    def read_command(self, text: str) -> OWordCommand:
        """Parse a cleaned line that begins with O (after its line number)."""
        return OWordCommand(text, self._variables, self._budget.max_nesting)

    def execute_command(self, command: OWordCommand, line: int) -> None:
        """Execute an O-word."""
        label = command.evaluate_label()
        self.repeats = True
        match command.keyword:
            case "sub":
                self._define_subroutine(label, line)
            case "call":
                self._call_subroutine(label, command, line)
            case "return" | "endsub":
                self._return_from_subroutine(label, command)
            case "if":
                self._execute_if(label, command, line)
            case "elseif":
                self._execute_elseif(label, command, line)
            case "else":
                self._execute_else(label, command, line)
            case "endif":
                self._find_label(label, ("if",), command)
            case "while":
                self._execute_while(label, command, line)
            case "endwhile":
                self._begin_next_turn(label, self._find_label(label, ("while",), command), command)
            case "do":
                self._open_label(label, "do", line)
            case "repeat":
                self._execute_repeat(label, command, line)
            case "endrepeat":
                self._end_repeat_turn(label, command)
            case "break" | "continue":
                self._leave_loop(label, command, line)
            case _:
                self._subs.setdefault(label, (self.source.get_place_before(), True))
        if command.keyword not in _WITH_VALUES and command.evaluate_values():
            raise command.build_error(f"{command.keyword} takes no value")

    # --- conditions and loops -------------------------------------------------------------------------------------

    def _open_label(self, label: str, kind: str, line: int) -> FlowLabel:
        labels = self._frames[-1].labels
        known = labels.get(label)
        if known is not None and (known.line != line or known.kind != kind):
            raise ProgramError(line, f"O<{label}>", f"is already the label of line {known.line}; choose another one")
        if known is None and len(labels) >= self._budget.max_labels:
            raise GcodeBudget(line, f"O<{label}>", f"exceeds the {self._budget.max_labels} labels allowed")
        if known is None:
            place = self.source.get_place_after() if kind in ("do", "repeat") else self.source.get_place_before()
            known = labels[label] = FlowLabel(kind, line, place)
        return known

    def _find_label(self, label: str, kinds: tuple[str, ...], command: OWordCommand) -> FlowLabel:
        known = self._frames[-1].labels.get(label)
        if known is None or known.kind not in kinds:
            raise command.build_error(f"has no {' or '.join(kinds)} of the same label before it")
        return known

    def _begin_next_turn(self, label: str, state: FlowLabel, command: OWordCommand) -> None:
        """Begin the next turn of a loop; ProgramError if its state has not changed, so that it would never end."""
        self._frames[-1].turning.add(label)
        self.repeating = True
        if state.turns.count_turn(self._copy_whole_state):
            raise command.build_error(
                "ends a turn that changes nothing, so the loop never ends; change its condition in the loop"
            )
        self.source.go_to(state.place)

    def _end_loop(self, label: str) -> None:
        frame = self._frames[-1]
        frame.turning.discard(label)
        frame.labels[label].turns.reset_turns()
        self.repeating = frame.repeated or bool(frame.turning)

    def _copy_whole_state(self) -> object:
        labels = [
            (frame.again, {name: (one.line, one.done, one.left) for name, one in frame.labels.items()})
            for frame in self._frames
        ]
        return labels, self._state()

    def _execute_if(self, label: str, command: OWordCommand, line: int) -> None:
        state = self._open_label(label, "if", line)
        state.done = command.evaluate_condition() != 0.0
        if not state.done:
            self._skip = SkipTarget(label, ("elseif", "else", "endif"), line, execute=True)

    def _execute_elseif(self, label: str, command: OWordCommand, line: int) -> None:
        state = self._find_label(label, ("if",), command)
        holds = command.evaluate_condition() != 0.0
        if state.done or not holds:
            keywords = ("elseif", "endif") if state.done else ("elseif", "else", "endif")
            self._skip = SkipTarget(label, keywords, line, execute=True)
        state.done = state.done or holds

    def _execute_else(self, label: str, command: OWordCommand, line: int) -> None:
        if self._find_label(label, ("if",), command).done:
            self._skip = SkipTarget(label, ("endif",), line)

    def _execute_while(self, label: str, command: OWordCommand, line: int) -> None:
        known = self._frames[-1].labels.get(label)
        if known is not None and known.kind == "do":
            if command.evaluate_condition() != 0.0:
                self._begin_next_turn(label, known, command)
            else:
                self._end_loop(label)
            return
        self._open_label(label, "while", line)
        if command.evaluate_condition() == 0.0:
            self._end_loop(label)
            self._skip = SkipTarget(label, ("endwhile",), line)

    def _execute_repeat(self, label: str, command: OWordCommand, line: int) -> None:
        state = self._open_label(label, "repeat", line)
        state.left = float(round(command.evaluate_condition()))
        self._end_loop(label)
        if state.left <= 0.0:
            self._skip = SkipTarget(label, ("endrepeat",), line)

    def _end_repeat_turn(self, label: str, command: OWordCommand) -> None:
        state = self._find_label(label, ("repeat",), command)
        state.left -= 1.0
        if state.left > 0.0:
            self._begin_next_turn(label, state, command)
        else:
            self._end_loop(label)

    def _leave_loop(self, label: str, command: OWordCommand, line: int) -> None:
        state = self._find_label(label, ("while", "do"), command)
        if command.keyword == "break":
            self._end_loop(label)
            self._skip = SkipTarget(label, ("endwhile",) if state.kind == "while" else ("while",), line)
        elif state.kind == "while":
            self._begin_next_turn(label, state, command)
        else:
            self._skip = SkipTarget(label, ("while",), line, execute=True)

    # --- subroutines ----------------------------------------------------------------------------------------------

    def _define_subroutine(self, label: str, line: int) -> None:
        if label in self._subs:
            raise ProgramError(line, f"O<{label}>", "is the name of another subroutine; choose another name")
        if self.depth:
            raise ProgramError(line, f"O<{label}>", "is defined within a subroutine; move it out")
        self._subs[label] = (self.source.get_place_before(), False)
        self._skip = SkipTarget(label, ("endsub",), line)

    def _call_subroutine(self, name: str, command: OWordCommand, line: int) -> None:
        arguments = command.evaluate_values()
        if len(arguments) > LOCAL_NUMBERS:
            raise command.build_error(f"has {len(arguments)} arguments; {LOCAL_NUMBERS} are allowed")
        self._enter_subroutine(CallFrame(name, self.source.get_place_after()), line)
        self._variables.enter_call(arguments)

    def call_or_end(self, block: Block, text: str) -> bool:
        """Execute M98 or M99, which begin their line (``text``) without its other words; False ends the program."""
        code = block.m["call"]
        if not text.startswith(f"m{code}") or (code == 99 and text != "m99"):
            raise block.build_error(f"M{code}", "must begin its line; M99 has no other words, M98 has P and L")
        if code == 99:
            return self._execute_m99()
        name, times = block.words.get("p", -1.0), block.words.get("l", 1.0)
        if name < 0.0 or not 0 <= times < 1e9 or not (is_whole(name) and is_whole(times)):
            raise block.build_error("M98", "needs the subroutine's number as P and may have its repeats as L")
        if round(times) > 0:
            back = self.source.get_place_after()
            self._enter_subroutine(CallFrame(str(round(name)), back, fanuc=True, again=round(times) - 1), block.line)
            self._variables.enter_call(None)
        return True

    def call_contour(self, block: Block, name: str) -> None:
        """Enter the subroutine that describes a contour (G70 to G72.2); it must precede the block."""
        known = self._subs.get(name)
        if known is None or known[1]:
            raise block.build_error("q", "names no subroutine before this line")
        self._enter_subroutine(CallFrame(name, self.source.get_place_after()), block.line)
        self._variables.enter_call([])

    def _enter_subroutine(self, frame: CallFrame, line: int) -> None:
        if self.depth >= self._budget.max_call_depth:
            raise GcodeBudget(line, f"O<{frame.name}>", f"calls nest deeper than {self._budget.max_call_depth} levels")
        known = self._subs.get(frame.name)
        frame.repeated = self.repeating or frame.name in self._entered
        self._entered.add(frame.name)
        self._frames.append(frame)
        self.repeating = frame.repeated
        self._entering = self.repeats = True
        self._skip = SkipTarget(frame.name, (FANUC,) if frame.fanuc else ("sub",), line)
        if known is not None:
            place, fanuc = known
            if fanuc != frame.fanuc:
                how = "M98" if fanuc else "call"
                raise ProgramError(line, f"O<{frame.name}>", f"is a subroutine that must be called by {how}")
            self._go_to_place(place)
            return
        path = self._find_subroutine_file(frame.name)
        if path is not None:
            self.source = ProgramSource(path, self._budget.max_line_chars)
            self._files.append(self.source)

    def _find_subroutine_file(self, name: str) -> Path | None:
        if self._folder is None or _FILE_NAME.fullmatch(name) is None:
            return None
        path = self._folder / f"{name}.ngc"
        return path if path.is_file() else None

    def _begin_subroutine(self, label: str, keyword: str) -> None:
        self._entering = False
        self._subs.setdefault(label, (self.source.get_place_before(), keyword == FANUC))
        self._frames[-1].entry = self.source.get_place_after()

    def _return_from_subroutine(self, label: str, command: OWordCommand) -> None:
        frame = self._frames[-1]
        if not self.depth or frame.fanuc:
            raise command.build_error(f"ends no subroutine; {command.keyword} belongs between sub and endsub")
        if command.keyword == "endsub" and frame.name != label:
            raise command.build_error(f"names another subroutine than the active O<{frame.name}>")
        values = command.evaluate_values()
        self._variables.leave_call()
        self._variables.returned = values[0] if values else None
        self._return_to_caller()

    def _execute_m99(self) -> bool:
        if not self.depth:
            return False
        frame = self._frames[-1]
        if not frame.fanuc:
            raise ProgramError(self.source.line, "M99", "cannot end a subroutine called by an O-word; use endsub")
        if frame.again > 0 and frame.entry is not None:
            frame.again -= 1
            frame.repeated = self.repeating = True
            self.source.go_to(frame.entry)
            return True
        self._variables.leave_call()
        self._return_to_caller()
        return True

    def _return_to_caller(self) -> None:
        frame = self._frames.pop()
        self.repeating = self._frames[-1].repeated or bool(self._frames[-1].turning)
        self._on_return(self.depth + 1)
        if frame.back is not None:
            self._go_to_place(frame.back)

    def _go_to_place(self, place: SourcePlace) -> None:
        self.source = place.source
        self.source.go_to(place)
