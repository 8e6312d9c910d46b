"""Runs Python code on unknown integers along every path, so that z3 can prove what holds on each.

The code under proof is called unchanged. Its integers are :class:`Integer`, which build z3 terms; where the code asks
whether a comparison holds, each possible answer is followed in a call of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import z3

DECIDE_MS = 60_000
PRUNE_MS = 1_000


class NotProven(AssertionError):
    """A claim that does not hold, with integers that show it, or one that z3 did not decide in time."""


class _Unreachable(Exception):
    """The assumptions contradict each other: no integers lead here."""


class _Path:
    """One path through the code: the answers that lead along it, and the facts that hold on it."""

    def __init__(self, answers: list[bool]) -> None:
        self.facts: list[z3.BoolRef] = []
        self.answers = answers
        self.untried: list[list[bool]] = []
        self._asked = 0
        self._solver = _solver(PRUNE_MS)

    def add(self, *facts: z3.BoolRef) -> None:
        """Add facts that hold from here on."""
        self.facts += facts
        self._solver.add(*facts)

    def decide(self, claim: z3.BoolRef) -> bool:
        """Return whether a comparison holds on this path; if undetermined, queue the other path."""
        if self._asked == len(self.answers):
            ways = [holds for holds in (True, False) if self._is_possible(_either(claim, holds))]
            if not ways:
                raise _Unreachable
            self.untried += [[*self.answers, holds] for holds in ways[1:]]
            self.answers.append(ways[0])
        holds = self.answers[self._asked]
        self._asked += 1
        self.add(_either(claim, holds))
        return holds

    def _is_possible(self, claim: z3.BoolRef) -> bool:
        """Return whether integers may lead there; an undecided path is followed."""
        return bool(self._solver.check(claim) != z3.unsat)


def _either(claim: z3.BoolRef, holds: bool) -> z3.BoolRef:
    return claim if holds else z3.Not(claim)


def _solver(timeout_ms: int, *facts: z3.BoolRef) -> z3.Solver:
    solver = z3.Solver()
    solver.set("timeout", timeout_ms)
    solver.add(*facts)
    return solver


_following: list[_Path] = []


@contextmanager
def _on(path: _Path) -> Iterator[None]:
    _following.append(path)
    try:
        yield
    finally:
        _following.pop()


def assume(*facts: Claim) -> None:
    """State a fact for the rest of the current path."""
    _following[-1].add(*[fact.term for fact in facts])


class Claim:
    """A comparison of unknown integers; its truth value is decided by the path."""

    def __init__(self, term: z3.BoolRef) -> None:
        self.term = term

    def __bool__(self) -> bool:
        simple = z3.simplify(self.term)
        return z3.is_true(simple) if z3.is_true(simple) or z3.is_false(simple) else _following[-1].decide(self.term)

    def __and__(self, other: Claim) -> Claim:
        return Claim(z3.And(self.term, other.term))

    def __or__(self, other: Claim) -> Claim:
        return Claim(z3.Or(self.term, other.term))

    def __invert__(self) -> Claim:
        return Claim(z3.Not(self.term))

    def implies(self, other: Claim) -> Claim:
        """Return the claim that the other holds where this one does."""
        return Claim(z3.Implies(self.term, other.term))


def _term(value: Integer | int) -> z3.ArithRef:
    return value.term if isinstance(value, Integer) else z3.IntVal(value)


class Integer:
    """An unknown integer, or an expression of some."""

    def __init__(self, term: z3.ArithRef) -> None:
        self.term = term

    def __add__(self, other: Integer | int) -> Integer:
        return Integer(self.term + _term(other))

    def __radd__(self, other: int) -> Integer:
        return Integer(_term(other) + self.term)

    def __sub__(self, other: Integer | int) -> Integer:
        return Integer(self.term - _term(other))

    def __rsub__(self, other: int) -> Integer:
        return Integer(_term(other) - self.term)

    def __mul__(self, other: Integer | int) -> Integer:
        return Integer(self.term * _term(other))

    def __rmul__(self, other: int) -> Integer:
        return Integer(_term(other) * self.term)

    def __floordiv__(self, other: Integer | int) -> Integer:
        """Divide, rounding down as Python does; z3 does so for a positive divisor, which is proven first."""
        prove(Claim(_term(other) > 0))
        return Integer(self.term / _term(other))

    def __neg__(self) -> Integer:
        return Integer(-self.term)

    def __abs__(self) -> Integer:
        return Integer(z3.If(self.term >= 0, self.term, -self.term))

    def __lt__(self, other: Integer | int) -> Claim:
        return Claim(self.term < _term(other))

    def __le__(self, other: Integer | int) -> Claim:
        return Claim(self.term <= _term(other))

    def __gt__(self, other: Integer | int) -> Claim:
        return Claim(self.term > _term(other))

    def __ge__(self, other: Integer | int) -> Claim:
        return Claim(self.term >= _term(other))

    def __eq__(self, other: object) -> Claim:  # type: ignore[override] # a comparison of unknowns is no bool yet
        assert isinstance(other, Integer | int)
        return Claim(self.term == _term(other))

    def __ne__(self, other: object) -> Claim:  # type: ignore[override]
        assert isinstance(other, Integer | int)
        return Claim(self.term != _term(other))

    def __bool__(self) -> bool:
        return bool(self != 0)

    __hash__ = None  # type: ignore[assignment]


def lemma(claim: Claim) -> None:
    """Prove a claim and use it as a fact."""
    prove(claim)
    assume(claim)


def choose(condition: Claim, holds: Integer | int, otherwise: Integer | int) -> Integer:
    """Return one of two integers without following two paths."""
    return Integer(z3.If(condition.term, _term(holds), _term(otherwise)))


def integers(names: str) -> list[Integer]:
    """Return an unknown integer for each name."""
    return [Integer(z3.Int(name)) for name in names.split()]


def prove(claim: Claim | bool) -> None:
    """Prove that a claim follows from the facts of the path; NotProven has a counterexample."""
    if isinstance(claim, bool):
        claim = Claim(z3.BoolVal(claim))
    solver = _solver(DECIDE_MS, *_following[-1].facts, z3.Not(claim.term))
    result = solver.check()
    if result != z3.unsat:
        shown = solver.model() if result == z3.sat else f"not decided: {solver.reason_unknown()}"
        raise NotProven(f"{z3.simplify(claim.term)}: {shown}")


def for_every_path(code: Callable[[], None]) -> int:
    """Run ``code``, which assumes and proves, once along each path; return the number of paths.

    NotProven where a claim does not hold, or where nothing was proven because the assumptions are contradictory.
    """
    untried: list[list[bool]] = [[]]
    followed = 0
    while untried:
        path = _Path(untried.pop())
        with _on(path):
            try:
                code()
            except _Unreachable:
                continue
            finally:
                untried += path.untried
        followed += _solver(DECIDE_MS, *path.facts).check() == z3.sat
    if not followed:
        raise NotProven("what is assumed is impossible")
    return followed
