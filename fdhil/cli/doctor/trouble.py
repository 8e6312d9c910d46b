"""A problem found by ``fdhil doctor``."""

from dataclasses import dataclass
from typing import Self


@dataclass(frozen=True, slots=True)
class Trouble:
    """A problem at ``place``: cause, effect on the machine, and fix; ``code`` is its class.

    ``grave``: a function fails until it is fixed; otherwise it only works worse than possible.
    """

    code: str
    place: str
    what: str
    means: str
    mend: str
    grave: bool = True

    @classmethod
    def create_from_error(cls, code: str, place: str, error: Exception, means: str, grave: bool = True) -> Self:
        """Return the problem that an error states, whose sentence has cause and fix, separated by a semicolon."""
        what, _, mend = str(error).partition("; ")
        return cls(code, place, what, means, mend, grave)
