"""Translates the values of an NC's interface into its state, by the rules of a profile. Pure.

A profile names signals, their places, and rules: the first rule that is met gives the motion. A rule that needs a
missing value is neither met nor skipped: the motion is then UNKNOWN, so that a missing "feed hold" never results in a
"rapid".
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from fdhil.drivers.nc.nc_blocks import BLOCKS, BlockReader
from fdhil.errors import ProtocolError
from fdhil.records import MoveKind, NcState

Shown = bool | int | float | str | tuple[Any, ...] | None
"""A value of an interface; None: missing."""
LARGEST_FEED_MM_MIN = 1e7
LARGEST_OVERRIDE = 10.0
LARGEST_COUNT = 10**9 - 1
TEXT = 400  # characters of a program's name
_NUMBERED = re.compile(r"^\s*[NO]?0*(\d{1,9})\s*$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Signal:
    """One value: ``at`` is its place in the interface's own notation, ``scale`` converts it to the unit of NcState.

    ``bit`` is taken of an integer, ``item`` of an array. ``reads``: the value itself, or the motion of the block whose
    text it is. An ``optional`` one may be absent.
    """

    name: str
    at: str
    scale: float = 1.0
    bit: int | None = None
    item: int | None = None
    reads: Literal["value", "iso_block", "klartext_block"] = "value"
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Condition:
    """What a signal must be: one of ``values`` (or an array that contains one), or a number within bounds."""

    values: tuple[bool | float | str, ...] = ()
    at_least: float = -math.inf
    at_most: float = math.inf

    def is_met(self, value: Shown) -> bool:
        if self.values:
            return any(each in self.values for each in (value if isinstance(value, tuple) else (value,)))
        number = _parse_number(value)
        return number is not None and self.at_least <= number <= self.at_most


@dataclass(frozen=True, slots=True)
class Rule:
    """The motion is ``kind`` when every condition is met."""

    kind: MoveKind
    when: Mapping[str, Condition]

    def is_met(self, values: Mapping[str, Shown]) -> bool | None:
        """Return whether it is met; None where that depends on a missing value."""
        needed = {name: values.get(name) for name in self.when}
        if any(value is not None and not self.when[name].is_met(value) for name, value in needed.items()):
            return False
        return None if None in needed.values() else True


@dataclass(frozen=True, slots=True)
class NcProfile:
    """How an NC shows its state: its signals by name, and the rules of its motion in order."""

    title: str
    interface: str
    signals: Mapping[str, Signal]
    rules: tuple[Rule, ...]
    notes: tuple[str, ...] = ()

    def determine_motion(self, values: Mapping[str, Shown]) -> MoveKind:
        """Return the kind of the first rule that is met, UNKNOWN where none is or a value is missing."""
        for rule in self.rules:
            holds = rule.is_met(values)
            if holds or holds is None:
                return rule.kind if holds else MoveKind.UNKNOWN
        return MoveKind.UNKNOWN


class StateTranslator:
    """Translates values of an interface into successive states; ``name`` is the NC's in messages."""

    def __init__(self, profile: NcProfile, name: str) -> None:
        self._profile, self._name = profile, name
        self._blocks: dict[str, BlockReader] = {}
        self.reset_blocks()

    def reset_blocks(self) -> None:
        """Reset the modal state after a reconnection."""
        self._blocks = {s.name: BLOCKS[s.reads]() for s in self._profile.signals.values() if s.reads in BLOCKS}

    def translate_state(self, shown: Mapping[str, Shown], stamp_ns: int, error_ns: int) -> NcState:
        """Translate the values of the signals into a state; ProtocolError for impossible values."""
        values = {s.name: _extract_value(s, shown.get(s.name)) for s in self._profile.signals.values()}
        fields = {name: self._convert_field(name, values[name]) for name in FIELDS if name in values}
        for name, blocks in self._blocks.items():
            text = values[name]
            kind = blocks.classify_block(text, fields.get("line")) if isinstance(text, str) else None
            values[name] = None if kind is None else kind.value
        return NcState(stamp_ns, error_ns, self._profile.determine_motion(values), **fields)

    def _convert_field(self, name: str, value: Shown) -> Any:
        if value is None:
            return None
        try:
            return FIELDS[name](value)
        except (ValueError, TypeError, OverflowError):
            text = f"reports {str(value)[:40]!r} as {name}; compare its place and scale in the profile with the NC"
            raise ProtocolError(self._name, text) from None


def _extract_value(signal: Signal, shown: Shown) -> Shown:
    value = shown
    if signal.item is not None:
        value = value[signal.item] if isinstance(value, tuple) and signal.item < len(value) else None
    if signal.bit is not None:
        return bool(value >> signal.bit & 1) if isinstance(value, int) else None
    if signal.scale != 1.0 and value is not None:
        number = _parse_number(value)
        return value if number is None else number * signal.scale
    return value


def _parse_number(value: Shown) -> float | None:
    if isinstance(value, tuple) or value is None:
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _require_within(most: float) -> Callable[[Shown], float]:
    def check_range(value: Shown) -> float:
        number = _parse_number(value)
        if number is None or not 0 <= number <= most:
            raise ValueError(f"{value!r} is not from 0 to {most:g}")
        return number

    return check_range


def _require_count(least: int) -> Callable[[Shown], int | None]:
    """Return a parser of whole numbers, also with an N or O in front; below ``least`` they mean none."""

    def check_count(value: Shown) -> int | None:
        if isinstance(value, str):
            found = _NUMBERED.match(value)
            return int(found[1]) if found and least <= int(found[1]) <= LARGEST_COUNT else None
        number = _parse_number(value)
        if number is None or number != round(number):
            raise ValueError(f"{value!r} is not a whole number")
        return int(number) if least <= number <= LARGEST_COUNT else None

    return check_count


def _parse_flag(value: Shown) -> bool:
    if value not in (0, 1):  # True and False, too
        raise ValueError(f"{value!r} is neither true nor false")
    return bool(value)


def _parse_text(value: Shown) -> str | None:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value.strip()[:TEXT] or None


FIELDS: Mapping[str, Callable[[Shown], Any]] = {
    "line": _require_count(1),
    "programmed_feed_mm_min": _require_within(LARGEST_FEED_MM_MIN),
    "feed_mm_min": _require_within(LARGEST_FEED_MM_MIN),
    "feed_override": _require_within(LARGEST_OVERRIDE),
    "rapid_override": _require_within(LARGEST_OVERRIDE),
    "feed_hold": _parse_flag,
    "tool": _require_count(0),
    "program": _parse_text,
}
"""Signals that are fields of NcState, with their parsers; all others are only used by the rules."""
