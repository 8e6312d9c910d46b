"""One value of a configuration in the making, with its source."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class SourcedValue:
    """A value with its ``source`` in words for the file; ``guessed``: a proposal that the operator must check."""

    value: Any
    source: str
    guessed: bool = False


def round_to_six_digits(value: float) -> float:
    """Return a number with six significant digits.

    >>> round_to_six_digits(0.1 + 0.2)
    0.3
    """
    return float(f"{value:.6g}")
