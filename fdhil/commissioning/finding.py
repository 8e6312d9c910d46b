"""Findings of a comparison between a drive and its configuration, and reading of optional objects."""

from dataclasses import dataclass

from fdhil.commissioning.master import Master
from fdhil.drivers import NO_OBJECT, NO_SUB_INDEX
from fdhil.errors import SdoAbort


@dataclass(frozen=True, slots=True)
class Finding:
    """One compared item, expected and found; ``ok`` None: it could not be compared.

    ``cause`` says what is wrong or why the item was not compared, ``advice`` what to do next. ``needed``: commissioning
    stops if the item cannot be compared.
    """

    point: str
    expected: str
    found: str
    ok: bool | None = True
    cause: str = ""
    advice: str = ""
    needed: bool = False


def read_optional(master: Master, index: int, sub: int = 0, *, signed: bool = False) -> int | None:
    """Read an integer object; None if the drive does not have it or refuses to return it."""
    try:
        return master.sdo.read_int(index, sub, signed=signed)
    except SdoAbort:
        return None


def has_object(master: Master, index: int) -> bool:
    """Return whether the drive has an object, readable or not."""
    try:
        master.sdo.read_bytes(index)
    except SdoAbort as abort:
        return abort.code not in (NO_OBJECT, NO_SUB_INDEX)
    return True


def report_missing_object(point: str, expected: str, *objects: str, needed: bool = False) -> Finding:
    """Return the finding for an item that cannot be compared because the drive has no such object."""
    shown = " and ".join(objects)
    advice = "see its manual for what it does instead"
    return Finding(point, expected, f"no {shown}", None, f"it has no {shown} that can be read", advice, needed)
