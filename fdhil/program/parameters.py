"""Numbered and named parameters: a program's variables, and its view of the machine's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fdhil.errors import GcodeBudget, ProgramError

LAST_NUMBER = 5601
LOCAL_NUMBERS = 30
_LOCAL = range(1, LOCAL_NUMBERS + 1)
_READ_ONLY = frozenset({*range(5400, 5410), *range(5420, 5429)})


class ProgramVariables:
    """The parameters #1 to #5602 and #<name>; #1 to #30 and names without leading underscore are local to the call.

    ``line`` is the executed line, ``returned`` the value of the last subroutine; ``state_numbers`` and ``state_names``
    read the machine's state. KeyError for a missing parameter.
    """

    def __init__(
        self,
        max_names: int,
        state_numbers: Mapping[int, Callable[[], float]],
        state_names: Mapping[str, Callable[[], float]],
    ) -> None:
        self._max = max_names
        self.returned: float | None = None
        self.line = 0
        self._numbers: dict[int, float] = {}
        self._globals: dict[str, float] = {}
        self._locals: dict[str, float] = {}
        self._stack: list[tuple[dict[int, float] | None, dict[str, float]]] = []
        self._state_numbers = state_numbers
        self._state_names = state_names

    def get_numbered(self, index: int) -> float:
        """Return #index; 0 if it was never set."""
        if index in self._state_numbers:
            return self._state_numbers[index]()
        if not 1 <= index <= LAST_NUMBER:
            raise KeyError(index)
        return self._numbers.get(index, 0.0)

    def get_named(self, name: str) -> float:
        """Return #<name>."""
        if name in self._state_names:
            return float(self._state_names[name]())
        return (self._globals if name.startswith("_") else self._locals)[name]

    def set_parameter(self, key: int | str, value: float, line: int) -> None:
        """Set #key; ProgramError for a read-only one, one out of range, or too many."""
        if isinstance(key, int):
            if key in self._state_numbers or key in _READ_ONLY or not 1 <= key <= LAST_NUMBER:
                raise ProgramError(line, f"#{key}", "cannot be set; use one of #1 to #5000")
            self._numbers[key] = value
            return
        if key in self._state_names:
            raise ProgramError(line, f"#<{key}>", "is read-only machine state; choose another name")
        names = self._globals if key.startswith("_") else self._locals
        if len(names) >= self._max and key not in names:
            raise GcodeBudget(line, f"#<{key}>", f"exceeds the {self._max} parameters allowed")
        names[key] = value

    def store_number(self, index: int, value: float) -> None:
        """Set a numbered parameter on behalf of the machine (offsets, homes)."""
        self._numbers[index] = value

    def copy_state(self) -> object:
        """Return a copy of all parameters of the program and of the current call."""
        return dict(self._numbers), dict(self._globals), dict(self._locals), self.returned

    def enter_call(self, arguments: list[float] | None) -> None:
        """Begin a call: its own local names and #1 to #30, the arguments first; None (M98) keeps the numbers."""
        saved = None
        if arguments is not None:
            saved = {index: self._numbers.pop(index) for index in _LOCAL if index in self._numbers}
            self._numbers.update(enumerate(arguments, start=1))
        self._stack.append((saved, self._locals))
        self._locals = {}

    def leave_call(self) -> None:
        """End a call and restore the caller's local parameters."""
        saved, self._locals = self._stack.pop()
        if saved is not None:
            for index in _LOCAL:
                self._numbers.pop(index, None)
            self._numbers.update(saved)
