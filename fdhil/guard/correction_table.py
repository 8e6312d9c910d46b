"""Passes a correction table to the guard as a descriptor of sealed memory, and checks it row by row.

Sealed memory cannot change, shrink or block while it is read, even if another process still has it open.
"""

import fcntl
import json
import os
import struct
import sys
from array import array
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from fdhil.cia402 import compute_target_range
from fdhil.errors import StoreError
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.guard_protocol import TABLE_NAME
from fdhil.guard.offset_limits import OffsetLimits, find_limit_violation

MAX_TABLE_BYTES = 16 << 20
MAX_HEAD_BYTES = 4096
SEALED = fcntl.F_SEAL_SEAL | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_WRITE
_LENGTH = struct.Struct("<I")
_TOO_NEAR = {
    "SoftwareLimit": "a software limit of the drive than twice the largest offset; lower max_offset_um",
    "PositionRange": "the end of the 32-bit range than the largest offset; move the workpiece, or use coarser steps",
}


Column = Collection[int]
"""A sequence of int, or an integer array of numpy."""
Travel = tuple[int, int] | None
"""The software limits of an axis, in increments."""


class TableRefused(Exception):
    """A table that must not be used; ``code`` is its class, ``str`` the sentence."""

    def __init__(self, code: str, text: str) -> None:
        self.code = code
        super().__init__(text)


def encode_table(
    axes: Sequence[str],
    demand: Mapping[str, Column],
    offset: Mapping[str, Column],
    program_digest: str,
    first: int = 0,
    final: bool = True,
) -> bytes:
    """Return the bytes of a table: a JSON header, then demand and offset of each axis as little-endian int32.

    ``first`` is the number of the first row; a streamed table is sent in pieces with ``final`` False in all but the
    last. ValueError when a value is not a 32-bit integer.
    """
    rows = len(demand[axes[0]])
    head = {"axes": list(axes), "first": first, "rows": rows, "final": final, "program": program_digest}
    text = json.dumps(head).encode()
    parts = [_LENGTH.pack(len(text)), text]
    for columns in (demand, offset):
        for axis in axes:
            if len(columns[axis]) != rows:
                raise ValueError(f"axis {axis} has {len(columns[axis])} rows, not {rows}")
            parts.append(_encode_int32(columns[axis]))
    return b"".join(parts)


def _encode_int32(values: Column) -> bytes:
    try:
        column = array("i", values)
    except (TypeError, OverflowError) as error:
        raise ValueError(f"a table holds integers of 32 bits only: {error}") from None
    if sys.byteorder == "big":
        column.byteswap()
    return column.tobytes()


def decode_table(body: bytes, sequence: int = 0) -> tuple[tuple[str, ...], CorrectedPath]:
    """Return the axes and rows of a table.

    TableRefused (``CorruptFile``) when it is not what ``encode_table`` writes.
    """
    try:
        (length,) = _LENGTH.unpack_from(body)
        if length > MAX_HEAD_BYTES:
            raise ValueError("its header is too long")
        head = json.loads(body[4 : 4 + length])
        axes, rows, first, program = head["axes"], head["rows"], head["first"], head["program"]
        if not (type(rows) is type(first) is int and 0 <= first < 1 << 31 and isinstance(program, str)):
            raise ValueError("its header counts no rows, or names no program")
        if not isinstance(axes, list) or not all(isinstance(axis, str) for axis in axes):
            raise ValueError("its header names no axes")
        columns = _decode_columns(body[4 + length :], rows, 2 * len(axes))
    except (struct.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise TableRefused("CorruptFile", f"the correction table cannot be read ({error}); plan it again") from None
    demand, offset = columns[: len(axes)], columns[len(axes) :]
    return tuple(axes), CorrectedPath(first, demand, offset, head.get("final") is True, program, sequence)


def _decode_columns(data: bytes, rows: int, count: int) -> tuple[Sequence[int], ...]:
    if rows < 1 or count < 2 or len(data) != 4 * rows * count:
        raise ValueError(f"{len(data)} bytes are not {count} columns of {rows} rows")
    columns = []
    for k in range(count):
        column = array("i")
        column.frombytes(data[4 * rows * k : 4 * rows * (k + 1)])
        if sys.byteorder == "big":
            column.byteswap()
        columns.append(column)
    return tuple(columns)


def seal_table(body: bytes) -> int:
    """Return a descriptor of sealed memory with the table; StoreError when it is too long or memory is exhausted."""
    if len(body) > MAX_TABLE_BYTES:
        raise StoreError(f"a correction table of {len(body)} bytes is too long for the guard; stream it in pieces")
    try:
        descriptor = os.memfd_create(TABLE_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            view = memoryview(body)
            while view:
                view = view[os.write(descriptor, view) :]
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, SEALED)
        except OSError:
            os.close(descriptor)
            raise
    except OSError as error:
        text = f"the correction table cannot be handed over ({error.strerror}), and nothing was loaded; free memory"
        raise StoreError(text) from None
    return descriptor


def read_sealed_memory(descriptor: int | None, most_bytes: int = MAX_TABLE_BYTES) -> bytes:
    """Return the content of sealed memory; TableRefused (``CorruptFile``, ``TableBusy`` above ``most_bytes``).

    The seals are checked first: only memory has any, so that anything else (a FIFO, a socket) is not read.
    """
    try:
        sealed = descriptor is not None and fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & SEALED == SEALED
    except OSError:
        sealed = False
    if descriptor is None or not sealed:
        text = "the correction table did not come as a descriptor of sealed memory, and it was not read; load it again"
        raise TableRefused("CorruptFile", text)
    size = os.fstat(descriptor).st_size
    if size > MAX_TABLE_BYTES:
        raise TableRefused("CorruptFile", f"a correction table of {size} bytes is too long; stream it in pieces")
    if size > most_bytes:
        raise TableRefused("TableBusy", "a table this long cannot be checked while a correction runs; disarm first")
    return os.pread(descriptor, size, 0)


def check_rows(limits: OffsetLimits, offsets: Sequence[int], start: int, stop: int) -> str | None:
    """Check rows [start, stop) of a table's offsets, with those before ``start``; return the class or None.

    The row before the first counts as standing at the first row's value: the fade-in brings the offset there.
    """
    for row in range(start, stop):
        before = offsets[max(row - 1, 0)]
        if not abs(offsets[row]) <= limits.offset:
            return "OffsetLimit"
        broken = find_limit_violation(limits, before, before - offsets[max(row - 2, 0)], offsets[row])
        if broken is not None:
            return broken
    return "OffsetEnergy" if not _is_variation_within_limit(limits, offsets, start, stop) else None


def _is_variation_within_limit(limits: OffsetLimits, offsets: Sequence[int], start: int, stop: int) -> bool:
    first = max(1, start - limits.window + 1)
    moves = [abs(offsets[row] - offsets[row - 1]) for row in range(first, stop)]
    travelled = 0
    for k, move in enumerate(moves):
        travelled += move - (moves[k - limits.window] if k >= limits.window else 0)
        if not travelled <= limits.variation:
            return False
    return True


def check_demand(travel: Travel, limits: OffsetLimits, demand: Sequence[int]) -> None:
    """Raise TableRefused unless these rows keep away from both ends of the axis.

    They keep the largest offset from the ends of 32 bits (``PositionRange``), twice that from the software limits
    (``SoftwareLimit``).
    """
    ends = [("SoftwareLimit", travel[0] + 2 * limits.offset, travel[1] - 2 * limits.offset)] if travel else []
    for code, low, high in (*ends, ("PositionRange", *compute_target_range(limits.offset))):
        if demand and not (low <= min(demand) and max(demand) <= high):
            raise TableRefused(code, f"the path comes nearer to {_TOO_NEAR[code]}")


@dataclass(slots=True)
class TableLoading:
    """A new table whose rows are checked a piece at a time, so that no SYNC waits for it.

    ``joined`` is the path with the new rows appended or replaced; ``done`` once all have passed, or those before
    ``stop``: the others are unchanged.
    """

    joined: CorrectedPath
    limits: tuple[OffsetLimits, ...]
    travel: tuple[Travel, ...] = ()
    next_row: int = field(default=0)
    stop: int | None = None

    @property
    def last(self) -> int:
        """One past the last row to be checked."""
        return self.joined.end if self.stop is None else self.stop

    @property
    def done(self) -> bool:
        """Whether all rows were checked."""
        return self.next_row >= self.last

    def check_next_rows(self, rows: int) -> None:
        """Check the next rows of all axes; TableRefused with the class of the first broken limit."""
        first = self.joined.first
        stop = min(self.next_row + rows, self.last)
        travels = self.travel or (None,) * len(self.limits)
        axes = zip(self.limits, travels, self.joined.demand, self.joined.offset, strict=True)
        for limits, travel, demand, offsets in axes:
            check_demand(travel, limits, demand[self.next_row - first : stop - first])
            broken = check_rows(limits, offsets, self.next_row - first, stop - first)
            if broken is not None:
                raise TableRefused(broken, f"rows {self.next_row} to {stop} break the limit; plan within the limits")
        self.next_row = stop


def begin_table(
    body: bytes,
    sequence: int,
    axes: Sequence[str],
    limits: tuple[OffsetLimits, ...],
    loaded: CorrectedPath | None,
    keep_from: int,
    travel: tuple[Travel, ...] = (),
) -> TableLoading:
    """Decode a new table and append it to the loaded one; rows before ``keep_from`` are dropped.

    TableRefused when it is for other axes or does not continue the loaded rows of the same program.
    """
    names, path = decode_table(body, sequence)
    if names != tuple(axes):
        raise TableRefused("ProgramMismatch", f"the table is for axes {', '.join(names)}, not {', '.join(axes)}")
    if path.first == 0 or loaded is None:
        if path.first != 0:
            raise TableRefused("ProgramMismatch", "a streamed table must begin with row 0; plan it again")
        return TableLoading(path, limits, travel)
    if path.first != loaded.end or path.program_digest != loaded.program_digest or loaded.final:
        raise TableRefused("ProgramMismatch", f"row {path.first} does not continue the loaded table; load it again")
    cut = max(0, min(keep_from, loaded.end - limits[0].window - 3) - loaded.first)
    if 8 * len(names) * (path.end - loaded.first - cut) > MAX_TABLE_BYTES:
        raise TableRefused(
            "TableBusy", "the guard holds as many rows as it can; wait until the machine has passed some"
        )
    joined = CorrectedPath(
        loaded.first + cut,
        _join_columns(loaded.demand, path.demand, cut),
        _join_columns(loaded.offset, path.offset, cut),
        path.final,
        path.program_digest,
        sequence,
    )
    return TableLoading(joined, limits, travel, next_row=loaded.end)


def begin_renewal(
    body: bytes,
    sequence: int,
    axes: Sequence[str],
    limits: tuple[OffsetLimits, ...],
    loaded: CorrectedPath | None,
    travel: tuple[Travel, ...] = (),
) -> TableLoading:
    """Replace the offsets of the first loaded rows, for a machine that has not started.

    TableRefused when they do not match: another program, more rows than loaded, or another demand.
    """
    names, path = decode_table(body)
    same = loaded is not None and names == tuple(axes) and path.first == loaded.first == 0 and path.end <= loaded.end
    if loaded is None or not same or path.program_digest != loaded.program_digest:
        raise TableRefused("ProgramMismatch", "the rows are not the first ones of the loaded table; load it again")
    if any(list(new) != list(old[: path.end]) for new, old in zip(path.demand, loaded.demand, strict=True)):
        raise TableRefused("ProgramMismatch", "the rows are those of another path than the loaded one; load it again")
    offset = tuple(
        [array("i", new) + array("i", old[path.end :]) for new, old in zip(path.offset, loaded.offset, strict=True)]
    )
    joined = replace(loaded, offset=offset, sequence=sequence)
    return TableLoading(joined, limits, travel, stop=min(joined.end, path.end + limits[0].window + 3))


def _join_columns(old: Sequence[Sequence[int]], new: Sequence[Sequence[int]], cut: int) -> tuple[Sequence[int], ...]:
    return tuple([array("i", before[cut:]) + array("i", after) for before, after in zip(old, new, strict=True)])
