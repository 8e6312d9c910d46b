"""Parses cells of text files: decimal marks, thousands separators, times of day, and words for lost values."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float

DECIMALS = ".,"
_NOTHING = """
nan -nan nan(ind) -nan(ind) na n/a #n/a #na #nv null none nil nat inf +inf -inf infinity -infinity
1.#qnan 1.#ind -1.#ind 1.#inf -1.#inf - -- --- ---- ? * *** **** ovl ovr ovf over overflow overload
invalid overrange underrange nodata error err #error #value! #div/0! missing lost
"""
VOID = frozenset(["", *_NOTHING.split()])  # words for a missing value
DAY_S, HALF_DAY_S = 86400.0, 43200.0
_MINUS = str.maketrans({"\u2212": "-", "\u2013": "-", "\u00a0": " ", "\u2007": " ", "\u2009": " ", "\u202f": " "})
_GROUPS = {".": "[,'\u2019 ]", ",": "[.'\u2019 ]"}  # thousands separators
_NUMBERS = {
    mark: re.compile(
        rf"([+-]?)(?:(\d+)|([1-9]\d{{0,2}})({group})(\d{{3}}(?:\4\d{{3}})*)|(?=[{mark}]\d))"
        rf"(?:[{mark}](\d*))?(?:[eEdD]([+-]?\d{{1,3}}))?"
    )
    for mark, group in _GROUPS.items()
}
_QUICK = re.compile(r" *-?\d+(?:[.,]\d+)? *")  # most cells
_DATE = r"(?:(?P<date>\d{1,4}[-./]\d{1,2}[-./]\d{1,4}|\d{1,2}[- ][A-Za-z]{3,4}[- ]\d{2,4})(?:[T ]|, ?) *)"
_CLOCK = re.compile(
    rf"{_DATE}?(?P<h>\d{{1,2}}):(?P<m>[0-5]\d):(?P<s>[0-5]?\d|60)(?:[.,](?P<f>\d+)|:(?P<f3>\d{{3}}|\d{{6}}))?"
    r" ?(?P<half>[AaPp]\.?[Mm]\.?)?(?P<zone>Z| ?[+-]\d{2}:?\d{2}| ?UTC)?"
)
_STOPWATCH = re.compile(r"(?P<m>\d{1,3}):(?P<s>[0-5]\d)[.,](?P<f>\d+)")


@dataclass(frozen=True, slots=True)
class CellColumn:
    """``values`` (n,) of a column, ``nan`` for lost ones; ``bad`` is the first row that is neither.

    ``is_clock``: the cells are times of day; the values are then seconds and continue past midnight.
    """

    values: Float
    bad: int | None = None
    is_clock: bool = False


def strip_cell(cell: str) -> str:
    """Return a cell without surrounding quotes and blanks, with ASCII minus sign and blanks."""
    return cell.translate(_MINUS).strip().strip("\"'").strip()


def is_void(cell: str) -> bool:
    """Return whether a cell means that there is no value."""
    return strip_cell(cell).lower() in VOID


def is_number(cell: str) -> bool:
    """Return whether a cell is a number with either decimal mark, or a time of day."""
    if _QUICK.fullmatch(cell) is not None:
        return True
    text = strip_cell(cell)
    return any(is_written_by(text, mark) for mark in DECIMALS) or _parse_clock(text) is not None


def is_clock(cell: str) -> bool:
    """Return whether a cell is a time of day, with or without a date."""
    return _parse_clock(strip_cell(cell)) is not None


def is_written_by(text: str, decimal: str) -> bool:
    """Return whether a plain text is a number with this decimal mark."""
    return _NUMBERS[decimal].fullmatch(text) is not None


def parse_column(cells: Sequence[str], decimal: str) -> CellColumn:
    """Return the cells as numbers with the decimal mark ``decimal``, or as times of day."""
    try:  # the usual format, ten times as fast
        return CellColumn(_parse_simple_numbers(cells, decimal))
    except ValueError:
        pass
    texts = [strip_cell(cell) for cell in cells]
    first = next((text for text in texts if text.lower() not in VOID), "")
    if _parse_clock(first) is not None:
        return _parse_clock_column(texts)
    values, bad = np.full(len(texts), np.nan), None
    for k, text in enumerate(texts):
        value = _parse_number(text, decimal)
        if value is not None:
            values[k] = value
        elif bad is None and text.lower() not in VOID:
            bad = k
    return CellColumn(values, bad)


def _parse_simple_numbers(cells: Sequence[str], decimal: str) -> Float:
    other = "," if decimal == "." else "."
    if any(other in cell or "_" in cell for cell in cells):
        raise ValueError
    values = np.array([float(cell.replace(decimal, ".")) for cell in cells])
    return np.where(np.isinf(values), np.nan, values)


def _parse_number(text: str, decimal: str) -> float | None:
    found = _NUMBERS[decimal].fullmatch(text)
    if found is None:
        return None
    sign, whole, leading, _, groups, fraction, exponent = found.groups()
    digits = whole or (leading or "") + re.sub(r"\D", "", groups or "")
    value = float(f"{sign}{digits or '0'}.{fraction or '0'}e{exponent or '0'}")
    return value if math.isfinite(value) else None


def _parse_clock(text: str) -> tuple[str, float] | None:
    found = _CLOCK.fullmatch(text) or _STOPWATCH.fullmatch(text)
    if found is None:
        return None
    part = found.groupdict()
    hour, half = int(part.get("h") or 0), (part.get("half") or "").lower()
    if half:
        hour = hour % 12 + (12 if half.startswith("p") else 0)
    seconds = float(f"{part['s']}.{part['f'] or part.get('f3') or '0'}")
    return f"{part.get('date') or ''}{part.get('zone') or ''}", 3600.0 * hour + 60.0 * int(part["m"]) + seconds


def _parse_clock_column(texts: Sequence[str]) -> CellColumn:
    """Return seconds; midnight is a drop of half a day or more, and only there may the date change."""
    values, before, dated = np.full(len(texts), np.nan), math.nan, ""
    for k, text in enumerate(texts):
        read = _parse_clock(text)
        if read is None:
            if text.lower() in VOID:
                continue
            return CellColumn(values, k, True)
        date, seconds = read
        midnight = before - seconds > HALF_DAY_S
        if not math.isnan(before) and (date != dated) and not midnight:
            return CellColumn(values, k, True)
        values[k], before, dated = seconds, seconds, date
    return CellColumn(unwrap_midnight(values), None, True)


def unwrap_midnight(seconds: Float) -> Float:
    """Return times of day that continue past midnight: a drop of half a day or more is a new day."""
    known = np.flatnonzero(np.isfinite(seconds))
    passed = np.cumsum(np.diff(seconds[known]) < -HALF_DAY_S)
    gone_on = seconds.copy()
    gone_on[known[1:]] += DAY_S * passed
    return gone_on
