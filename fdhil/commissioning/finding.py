"""One point of a comparison between a drive and its configuration, and how an object that may lack is read."""

from dataclasses import dataclass

from fdhil.commissioning.master import Master
from fdhil.drivers.can.sdo import NO_OBJECT, NO_SUB_INDEX
from fdhil.errors import SdoAbort


@dataclass(frozen=True, slots=True)
class Finding:
    """One point of the set-up, expected and found; ``ok`` None: it could not be compared.

    ``cause`` and ``advice`` are the halves of the sentence that tells what is wrong, or why it was not compared, and
    what to do next. ``needed``: what cannot be compared here ends a commissioning.
    """

    point: str
    expected: str
    found: str
    ok: bool | None = True
    cause: str = ""
    advice: str = ""
    needed: bool = False


def read_optional(master: Master, index: int, sub: int = 0, *, signed: bool = False) -> int | None:
    """Read an integer object, None when the drive does not have it, or refuses to tell it."""
    try:
        return master.sdo.read_int(index, sub, signed=signed)
    except SdoAbort:
        return None


def has_object(master: Master, index: int) -> bool:
    """Whether the drive has an object, also one that it refuses to tell."""
    try:
        master.sdo.read(index)
    except SdoAbort as abort:
        return abort.code not in (NO_OBJECT, NO_SUB_INDEX)
    return True


def lacks(point: str, expected: str, *objects: str, needed: bool = False) -> Finding:
    """A point that cannot be compared, for the drive has no such object."""
    shown = " and ".join(objects)
    advice = "its manual says what it does instead"
    return Finding(point, expected, f"no {shown}", None, f"it has no {shown} that can be read", advice, needed)
