"""A problem found by ``fdhil doctor``."""

from dataclasses import dataclass


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
