"""The file through which a correction table reaches the guard: two slots {sequence, length, CRC-32, body}.

The writer fills the older slot and its header last; the reader takes the valid slot with the highest sequence. A
slot whose CRC is wrong is no table. Both use plain positioned reads and writes: the pages are the same as a mapping's,
but a file that someone truncates is an error value here, where a mapping would end the guard by SIGBUS.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import zlib
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, Protocol

from fdhil.errors import StoreError
from fdhil.guard.limits import Limits, violation
from fdhil.guard.path import Path

MAGIC = b"FDHT"
SLOT_BYTES = 32 << 20
_HEADER = struct.Struct("<4sIQI")  # magic, length of the body, sequence, CRC-32 of length, sequence and body
_LENGTH = struct.Struct("<I")


class Array(Protocol):
    """An integer array of numpy, which this room does not import."""

    def tolist(self) -> Any:
        """Return the values as a list of int."""

    def __len__(self) -> int:
        """Number of rows."""


Column = Sequence[int] | Array
Travel = tuple[int, int] | None
"""The software limits of an axis, in increments."""


class TableRefused(Exception):
    """A table that must not be used; ``code`` is its class, ``str`` the sentence."""

    def __init__(self, code: str, text: str) -> None:
        self.code = code
        super().__init__(text)


def encode(
    axes: Sequence[str],
    demand: Mapping[str, Column],
    offset: Mapping[str, Column],
    program_digest: str,
    first: int = 0,
    final: bool = True,
) -> bytes:
    """Return the body of a table: a JSON header, then demand and offset of each axis as little-endian int32.

    ``first`` is the number of the first row; a table that is streamed is sent in pieces with ``final`` False but in
    the last. Numpy integer arrays are accepted. ValueError when a value is no integer of 32 bits.
    """
    rows = len(demand[axes[0]])
    head = {"axes": list(axes), "first": first, "rows": rows, "final": final, "program": program_digest}
    text = json.dumps(head).encode()
    parts = [_LENGTH.pack(len(text)), text]
    for columns in (demand, offset):
        for axis in axes:
            if len(columns[axis]) != rows:
                raise ValueError(f"axis {axis} has {len(columns[axis])} rows, not {rows}")
            parts.append(_to_int32(columns[axis]))
    return b"".join(parts)


def _to_int32(values: Column) -> bytes:
    whole = values if isinstance(values, Sequence) else values.tolist()
    try:
        column = array("i", whole)
    except (TypeError, OverflowError) as error:
        raise ValueError(f"a table holds integers of 32 bits only: {error}") from None
    if sys.byteorder == "big":
        column.byteswap()
    return column.tobytes()


def decode(body: bytes, sequence: int = 0) -> tuple[tuple[str, ...], Path]:
    """Return the axes and the rows of a body; TableRefused (``CorruptFile``) when it is not what ``encode`` writes."""
    try:
        (length,) = _LENGTH.unpack_from(body)
        head = json.loads(body[4 : 4 + length])
        axes, rows, first = tuple(map(str, head["axes"])), int(head["rows"]), int(head["first"])
        columns = _columns(body[4 + length :], rows, 2 * len(axes))
        path = Path(
            first, columns[: len(axes)], columns[len(axes) :], head["final"] is True, str(head["program"]), sequence
        )
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise TableRefused("CorruptFile", f"the correction table cannot be read ({error}); plan it again") from None
    return axes, path


def _columns(data: bytes, rows: int, count: int) -> tuple[Sequence[int], ...]:
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


def write(file: FilePath, body: bytes, slot_bytes: int = SLOT_BYTES) -> int:
    """Write a body into the older slot and return its sequence; StoreError when it does not fit or cannot be written.

    One writer at a time. The header goes last, so that a torn write is a slot with a wrong CRC.
    """
    if _HEADER.size + len(body) > slot_bytes:
        raise StoreError(f"{file}: a table of {len(body)} bytes does not fit its slot; stream it in pieces")
    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            sequences = [_valid_sequence(descriptor, slot, slot_bytes) for slot in (0, 1)]
            slot = 0 if sequences[0] <= sequences[1] else 1
            sequence = max(sequences) + 1
            _write_all(descriptor, body, slot * slot_bytes + _HEADER.size)
            _write_all(descriptor, _header(body, sequence), slot * slot_bytes)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise StoreError(f"{file}: the correction table cannot be written ({error.strerror}); free the disk") from None
    return sequence


def read(file: FilePath, newer_than: int = 0, slot_bytes: int = SLOT_BYTES) -> tuple[int, bytes] | None:
    """Return (sequence, body) of the newest valid slot whose sequence is above ``newer_than``, or None."""
    try:
        descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        order = sorted(((_sequence(descriptor, slot, slot_bytes), slot) for slot in (0, 1)), reverse=True)
        for sequence, slot in order:
            if sequence <= newer_than:
                return None
            body = _body(descriptor, slot, slot_bytes)
            if body is not None:
                return sequence, body
    except OSError:
        return None
    finally:
        os.close(descriptor)
    return None


def _header(body: bytes, sequence: int) -> bytes:
    return _HEADER.pack(MAGIC, len(body), sequence, _crc(body, sequence))


def _crc(body: bytes, sequence: int) -> int:
    return zlib.crc32(body, zlib.crc32(struct.pack("<IQ", len(body), sequence)))


def _write_all(descriptor: int, data: bytes, position: int) -> None:
    view = memoryview(data)
    while view:
        written = os.pwrite(descriptor, view, position)
        view, position = view[written:], position + written


def _sequence(descriptor: int, slot: int, slot_bytes: int) -> int:
    """The sequence that a slot's header claims; 0 when it is no header."""
    raw = os.pread(descriptor, _HEADER.size, slot * slot_bytes)
    if len(raw) < _HEADER.size:
        return 0
    magic, length, sequence, _ = _HEADER.unpack(raw)
    return int(sequence) if magic == MAGIC and _HEADER.size + length <= slot_bytes else 0


def _valid_sequence(descriptor: int, slot: int, slot_bytes: int) -> int:
    """The sequence of a slot whose CRC is right, else 0: a damaged slot is the first to be written over."""
    return 0 if _body(descriptor, slot, slot_bytes) is None else _sequence(descriptor, slot, slot_bytes)


def _body(descriptor: int, slot: int, slot_bytes: int) -> bytes | None:
    raw = os.pread(descriptor, _HEADER.size, slot * slot_bytes)
    if len(raw) < _HEADER.size:
        return None
    magic, length, sequence, crc = _HEADER.unpack(raw)
    if magic != MAGIC or _HEADER.size + length > slot_bytes:
        return None
    body = os.pread(descriptor, length, slot * slot_bytes + _HEADER.size)
    return body if len(body) == length and _crc(body, sequence) == crc else None


def check_rows(limits: Limits, offsets: Sequence[int], start: int, stop: int) -> str | None:
    """Check rows [start, stop) of a table's offsets, with what lies before ``start``; return the class or None.

    The row before the first is taken to be at rest at the first row's value: the fade-in brings the offset there.
    """
    for row in range(start, stop):
        before = offsets[max(row - 1, 0)]
        if not abs(offsets[row]) <= limits.offset:
            return "OffsetLimit"
        broken = violation(limits, before, before - offsets[max(row - 2, 0)], offsets[row])
        if broken is not None:
            return broken
    return "OffsetEnergy" if not _variation_fits(limits, offsets, start, stop) else None


def _variation_fits(limits: Limits, offsets: Sequence[int], start: int, stop: int) -> bool:
    first = max(1, start - limits.window + 1)
    moves = [abs(offsets[row] - offsets[row - 1]) for row in range(first, stop)]
    travelled = 0
    for k, move in enumerate(moves):
        travelled += move - (moves[k - limits.window] if k >= limits.window else 0)
        if not travelled <= limits.variation:
            return False
    return True


def near_no_end(travel: tuple[int, int], limits: Limits, demand: Sequence[int]) -> bool:
    """Whether these rows keep twice the largest offset away from both software limits."""
    low, high = travel
    return not demand or (low + 2 * limits.offset <= min(demand) and max(demand) <= high - 2 * limits.offset)


@dataclass(slots=True)
class Loading:
    """A table on its way in: its rows are checked a piece at a time, so that no SYNC waits for it.

    ``joined`` is the path with the new rows behind the old ones; ``done`` once every row has passed.
    """

    joined: Path
    limits: tuple[Limits, ...]
    travel: tuple[Travel, ...] = ()
    next_row: int = field(default=0)

    @property
    def done(self) -> bool:
        """Whether all rows were checked."""
        return self.next_row >= self.joined.end

    def check(self, rows: int) -> None:
        """Check the next rows of all axes; TableRefused with the class of the first limit that is broken."""
        first = self.joined.first
        stop = min(self.next_row + rows, self.joined.end)
        for limits, travel, demand in zip(self.limits, self.travel, self.joined.demand, strict=False):
            rows_now = demand[self.next_row - first : stop - first]
            if travel is not None and not near_no_end(travel, limits, rows_now):
                text = "the path comes nearer to a software limit of the drive than twice the largest offset"
                raise TableRefused("SoftwareLimit", f"{text}; lower max_offset_um, or move the work away from the end")
        for limits, offsets in zip(self.limits, self.joined.offset, strict=True):
            broken = check_rows(limits, offsets, self.next_row - first, stop - first)
            if broken is not None:
                raise TableRefused(
                    broken, f"rows {self.next_row} to {stop} break the limit; plan the correction inside the limits"
                )
        self.next_row = stop


def begin(
    body: bytes,
    sequence: int,
    axes: Sequence[str],
    limits: tuple[Limits, ...],
    loaded: Path | None,
    keep_from: int,
    travel: tuple[Travel, ...] = (),
) -> Loading:
    """Decode a new body and join it to what is loaded; rows before ``keep_from`` are let go.

    TableRefused when it belongs to other axes or does not continue the loaded rows of the same program.
    """
    names, path = decode(body, sequence)
    if names != tuple(axes):
        raise TableRefused("ProgramMismatch", f"the table is for axes {', '.join(names)}, not {', '.join(axes)}")
    if path.first == 0 or loaded is None:
        if path.first != 0:
            raise TableRefused("ProgramMismatch", "a streamed table must begin with row 0; plan it again")
        return Loading(path, limits, travel)
    if path.first != loaded.end or path.program_digest != loaded.program_digest or loaded.final:
        raise TableRefused("ProgramMismatch", f"row {path.first} does not continue the loaded table; load it anew")
    cut = max(0, min(keep_from, loaded.end - limits[0].window - 3) - loaded.first)
    joined = Path(
        loaded.first + cut,
        _join(loaded.demand, path.demand, cut),
        _join(loaded.offset, path.offset, cut),
        path.final,
        path.program_digest,
        sequence,
    )
    return Loading(joined, limits, travel, next_row=loaded.end)


def _join(old: Sequence[Sequence[int]], new: Sequence[Sequence[int]], cut: int) -> tuple[Sequence[int], ...]:
    return tuple(array("i", [*before[cut:], *after]) for before, after in zip(old, new, strict=True))
