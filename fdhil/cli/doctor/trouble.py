"""Names one thing that is wrong with a machine's PC, and what mends it."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Trouble:
    """What is wrong at ``place``, what it means for the machine, and what mends it; ``code`` is its class.

    ``grave``: fdhil, or what was asked of it, does not work until it is mended; else it works worse than it could.
    """

    code: str
    place: str
    what: str
    means: str
    mend: str
    grave: bool = True
