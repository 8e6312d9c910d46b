"""One value of a configuration that is being made, and who said so."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Told:
    """A value, and its ``source`` in words for the file; ``guessed``: it is a proposal that the operator must check."""

    value: Any
    source: str
    guessed: bool = False


def rounded(value: float) -> float:
    """Return a number with six digits: what was calculated has no more to say.

    >>> rounded(0.1 + 0.2)
    0.3
    """
    return float(f"{value:.6g}")
