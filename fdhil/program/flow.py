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
from fdhil.program.commands import FANUC, Command
from fdhil.program.expressions import is_whole
from fdhil.program.frames import Frame, Label, Skip
from fdhil.program.parameters import LOCAL_NUMBERS, Variables
from fdhil.program.source import Place, Source
from fdhil.program.words import Block, clean, without_number

_MAYBE_O_WORD = re.compile(r"[\s/]*(?:n[\d.\s]*)?o", re.IGNORECASE)
_WITH_VALUES = ("call", "return", "endsub", "if", "elseif", "while", "repeat")
_FILE_NAME = re.compile(r"[\w+-][\w .+-]*")


class Flow:
    """Tracks the position of execution; ``on_return`` is called at the end of a call, ``state`` copies the state."""

    def __init__(
        self,
        source: Source,
        variables: Variables,
        budget: Budget,
        on_return: Callable[[int], None],
        state: Callable[[], object],
    ) -> None:
        self.source = source
        self._variables = variables
        self._budget = budget
        self._on_return = on_return
        self._state = state
        self._frames = [Frame("")]
        self._subs: dict[str, tuple[Place, bool]] = {}
        self._entered: set[str] = set()
        self._skip: Skip | None = None
        self._entering = False
        self.repeats = False  # lines may be repeated, so that parsed lines are worth keeping
        self.repeating = False  # the current lines were executed before, in this loop or subroutine
        self._known: dict[str, Command] = {}
        self._folder = source.folder
        self._files: list[Source] = [source]

    @property
    def depth(self) -> int:
        """Number of active calls."""
        return len(self._frames) - 1

    @property
    def skipping(self) -> bool:
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

    def at_end(self) -> None:
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

    def skip_over(self, raw: str, line: int) -> None:
        """Check a skipped line: it may be the one that is searched."""
        if _MAYBE_O_WORD.match(raw) is None:
            return
        command = self._known.get(raw)
        if command is None:
            text = without_number(clean(raw, line).lstrip("/"))
            if not text.startswith("o"):
                return
            command = self._known[raw] = self.read(text)
            if len(self._known) > self._budget.max_kept_lines:
                self._known.clear()
        label, skip = command.label(), self._skip
        if command.keyword == "sub" and skip is not None and skip.keywords == ("endsub",):
            raise command.fault(f"begins within the subroutine O<{skip.label}>; move it out")
        if skip is None or label != skip.label or command.keyword not in skip.keywords:
            return
        self._skip = None
        if self._entering:
            self._begin_sub(label, command.keyword)
        elif skip.execute:
            self.execute(command, line)

    def read(self, text: str) -> Command:
        """Parse a cleaned line that begins with O (after its line number)."""
        return Command(text, self._variables, self._budget.max_nesting)

    def execute(self, command: Command, line: int) -> None:
        """Execute an O-word."""
        label = command.label()
        self.repeats = True
        match command.keyword:
            case "sub":
                self._define(label, line)
            case "call":
                self._call(label, command, line)
            case "return" | "endsub":
                self._return(label, command)
            case "if":
                self._if(label, command, line)
            case "elseif":
                self._elseif(label, command, line)
            case "else":
                self._otherwise(label, command, line)
            case "endif":
                self._label(label, ("if",), command)
            case "while":
                self._while(label, command, line)
            case "endwhile":
                self._turn(label, self._label(label, ("while",), command), command)
            case "do":
                self._open(label, "do", line)
            case "repeat":
                self._repeat(label, command, line)
            case "endrepeat":
                self._next_repeat(label, command)
            case "break" | "continue":
                self._leave_loop(label, command, line)
            case _:
                self._subs.setdefault(label, (self.source.here(), True))
        if command.keyword not in _WITH_VALUES and command.values():
            raise command.fault(f"{command.keyword} takes no value")

    # --- conditions and loops -------------------------------------------------------------------------------------

    def _open(self, label: str, kind: str, line: int) -> Label:
        labels = self._frames[-1].labels
        known = labels.get(label)
        if known is not None and (known.line != line or known.kind != kind):
            raise ProgramError(line, f"O<{label}>", f"is already the label of line {known.line}; choose another one")
        if known is None and len(labels) >= self._budget.max_labels:
            raise GcodeBudget(line, f"O<{label}>", f"exceeds the {self._budget.max_labels} labels allowed")
        if known is None:
            place = self.source.after() if kind in ("do", "repeat") else self.source.here()
            known = labels[label] = Label(kind, line, place)
        return known

    def _label(self, label: str, kinds: tuple[str, ...], command: Command) -> Label:
        known = self._frames[-1].labels.get(label)
        if known is None or known.kind not in kinds:
            raise command.fault(f"has no {' or '.join(kinds)} of the same label before it")
        return known

    def _turn(self, label: str, state: Label, command: Command) -> None:
        """Begin the next turn of a loop; ProgramError if its state has not changed, so that it would never end."""
        self._frames[-1].turning.add(label)
        self.repeating = True
        if state.turns.one_more(self._whole_state):
            raise command.fault(
                "ends a turn that changes nothing, so the loop never ends; change its condition in the loop"
            )
        self.source.go(state.place)

    def _left(self, label: str) -> None:
        frame = self._frames[-1]
        frame.turning.discard(label)
        frame.labels[label].turns.end()
        self.repeating = frame.repeated or bool(frame.turning)

    def _whole_state(self) -> object:
        labels = [
            (frame.again, {name: (one.line, one.done, one.left) for name, one in frame.labels.items()})
            for frame in self._frames
        ]
        return labels, self._state()

    def _if(self, label: str, command: Command, line: int) -> None:
        state = self._open(label, "if", line)
        state.done = command.condition() != 0.0
        if not state.done:
            self._skip = Skip(label, ("elseif", "else", "endif"), line, execute=True)

    def _elseif(self, label: str, command: Command, line: int) -> None:
        state = self._label(label, ("if",), command)
        holds = command.condition() != 0.0
        if state.done or not holds:
            keywords = ("elseif", "endif") if state.done else ("elseif", "else", "endif")
            self._skip = Skip(label, keywords, line, execute=True)
        state.done = state.done or holds

    def _otherwise(self, label: str, command: Command, line: int) -> None:
        if self._label(label, ("if",), command).done:
            self._skip = Skip(label, ("endif",), line)

    def _while(self, label: str, command: Command, line: int) -> None:
        known = self._frames[-1].labels.get(label)
        if known is not None and known.kind == "do":
            if command.condition() != 0.0:
                self._turn(label, known, command)
            else:
                self._left(label)
            return
        self._open(label, "while", line)
        if command.condition() == 0.0:
            self._left(label)
            self._skip = Skip(label, ("endwhile",), line)

    def _repeat(self, label: str, command: Command, line: int) -> None:
        state = self._open(label, "repeat", line)
        state.left = float(round(command.condition()))
        self._left(label)
        if state.left <= 0.0:
            self._skip = Skip(label, ("endrepeat",), line)

    def _next_repeat(self, label: str, command: Command) -> None:
        state = self._label(label, ("repeat",), command)
        state.left -= 1.0
        if state.left > 0.0:
            self._turn(label, state, command)
        else:
            self._left(label)

    def _leave_loop(self, label: str, command: Command, line: int) -> None:
        state = self._label(label, ("while", "do"), command)
        if command.keyword == "break":
            self._left(label)
            self._skip = Skip(label, ("endwhile",) if state.kind == "while" else ("while",), line)
        elif state.kind == "while":
            self._turn(label, state, command)
        else:
            self._skip = Skip(label, ("while",), line, execute=True)

    # --- subroutines ----------------------------------------------------------------------------------------------

    def _define(self, label: str, line: int) -> None:
        if label in self._subs:
            raise ProgramError(line, f"O<{label}>", "is the name of another subroutine; choose another name")
        if self.depth:
            raise ProgramError(line, f"O<{label}>", "is defined within a subroutine; move it out")
        self._subs[label] = (self.source.here(), False)
        self._skip = Skip(label, ("endsub",), line)

    def _call(self, name: str, command: Command, line: int) -> None:
        arguments = command.values()
        if len(arguments) > LOCAL_NUMBERS:
            raise command.fault(f"has {len(arguments)} arguments; {LOCAL_NUMBERS} are allowed")
        self._enter(Frame(name, self.source.after()), line)
        self._variables.enter(arguments)

    def call_or_end(self, block: Block, text: str) -> bool:
        """Execute M98 or M99, which begin their line (``text``) without its other words; False ends the program."""
        code = block.m["call"]
        if not text.startswith(f"m{code}") or (code == 99 and text != "m99"):
            raise block.fault(f"M{code}", "must begin its line; M99 has no other words, M98 has P and L")
        if code == 99:
            return self._end_fanuc()
        name, times = block.words.get("p", -1.0), block.words.get("l", 1.0)
        if name < 0.0 or not 0 <= times < 1e9 or not (is_whole(name) and is_whole(times)):
            raise block.fault("M98", "needs the subroutine's number as P and may have its repeats as L")
        if round(times) > 0:
            back = self.source.after()
            self._enter(Frame(str(round(name)), back, fanuc=True, again=round(times) - 1), block.line)
            self._variables.enter(None)
        return True

    def call_contour(self, block: Block, name: str) -> None:
        """Enter the subroutine that describes a contour (G70 to G72.2); it must precede the block."""
        known = self._subs.get(name)
        if known is None or known[1]:
            raise block.fault("q", "names no subroutine before this line")
        self._enter(Frame(name, self.source.after()), block.line)
        self._variables.enter([])

    def _enter(self, frame: Frame, line: int) -> None:
        if self.depth >= self._budget.max_call_depth:
            raise GcodeBudget(line, f"O<{frame.name}>", f"calls nest deeper than {self._budget.max_call_depth} levels")
        known = self._subs.get(frame.name)
        frame.repeated = self.repeating or frame.name in self._entered
        self._entered.add(frame.name)
        self._frames.append(frame)
        self.repeating = frame.repeated
        self._entering = self.repeats = True
        self._skip = Skip(frame.name, (FANUC,) if frame.fanuc else ("sub",), line)
        if known is not None:
            place, fanuc = known
            if fanuc != frame.fanuc:
                how = "M98" if fanuc else "call"
                raise ProgramError(line, f"O<{frame.name}>", f"is a subroutine that must be called by {how}")
            self._go(place)
            return
        path = self._file_of(frame.name)
        if path is not None:
            self.source = Source(path, self._budget.max_line_chars)
            self._files.append(self.source)

    def _file_of(self, name: str) -> Path | None:
        if self._folder is None or _FILE_NAME.fullmatch(name) is None:
            return None
        path = self._folder / f"{name}.ngc"
        return path if path.is_file() else None

    def _begin_sub(self, label: str, keyword: str) -> None:
        self._entering = False
        self._subs.setdefault(label, (self.source.here(), keyword == FANUC))
        self._frames[-1].entry = self.source.after()

    def _return(self, label: str, command: Command) -> None:
        frame = self._frames[-1]
        if not self.depth or frame.fanuc:
            raise command.fault(f"ends no subroutine; {command.keyword} belongs between sub and endsub")
        if command.keyword == "endsub" and frame.name != label:
            raise command.fault(f"names another subroutine than the active O<{frame.name}>")
        values = command.values()
        self._variables.leave()
        self._variables.returned = values[0] if values else None
        self._go_back()

    def _end_fanuc(self) -> bool:
        if not self.depth:
            return False
        frame = self._frames[-1]
        if not frame.fanuc:
            raise ProgramError(self.source.line, "M99", "cannot end a subroutine called by an O-word; use endsub")
        if frame.again > 0 and frame.entry is not None:
            frame.again -= 1
            frame.repeated = self.repeating = True
            self.source.go(frame.entry)
            return True
        self._variables.leave()
        self._go_back()
        return True

    def _go_back(self) -> None:
        frame = self._frames.pop()
        self.repeating = self._frames[-1].repeated or bool(self._frames[-1].turning)
        self._on_return(self.depth + 1)
        if frame.back is not None:
            self._go(frame.back)

    def _go(self, place: Place) -> None:
        self.source = place.source
        self.source.go(place)
