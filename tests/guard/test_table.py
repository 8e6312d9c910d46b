"""The table that is handed over: what is not as it must be is no table, and one class says so."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.errors import StoreError
from fdhil.guard import table
from fdhil.guard.limits import OffsetLimits
from fdhil.guard.path import CorrectedPath
from fdhil.guard.table import TableRefused
from tests.guard.machine import LIMITS

ROWS = {"X": [0, 1, 3, 6], "Y": [5, 5, 5, 5]}
OFFSETS = {"X": [0, 1, 2, 3], "Y": [0, 0, -1, -1]}


def body(program: str = "p", first: int = 0, final: bool = True) -> bytes:
    return table.encode("XY", ROWS, OFFSETS, program, first, final)


@given(
    st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1)), min_size=1, max_size=50),
    st.text(max_size=20),
    st.booleans(),
)
def test_rows_come_back(rows: list[tuple[int, int]], program: str, final: bool) -> None:
    demand, offset = ([row[k] for row in rows] for k in (0, 1))
    names, path = table.decode(table.encode("X", {"X": demand}, {"X": offset}, program, 3, final), 7)
    assert names == ("X",)
    assert [list(path.demand[0]), list(path.offset[0])] == [demand, offset]
    assert (path.first, path.end, path.final, path.program_digest) == (3, 3 + len(rows), final, program)
    assert path.sequence == 7


@pytest.mark.fault("E3")
def test_numpy_integers_are_taken_and_floats_are_not() -> None:
    whole = table.encode("X", {"X": np.array([1, 2], dtype=np.int64)}, {"X": np.array([0, 0])}, "p")
    assert list(table.decode(whole)[1].demand[0]) == [1, 2]
    for wrong in ([1.0], [float("nan")], [2**31], ["1"]):
        with pytest.raises(ValueError, match="integers of 32 bits"):
            table.encode("X", {"X": wrong}, {"X": [0]}, "p")  # type: ignore[dict-item] # what must be refused
    with pytest.raises(ValueError, match="rows"):
        table.encode("X", {"X": [1]}, {"X": [1, 2]}, "p")


def sealed(seals: int, content: bytes = b"") -> int:
    descriptor = os.memfd_create("test", os.MFD_ALLOW_SEALING)
    os.write(descriptor, content)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
    return descriptor


def test_a_table_is_handed_over_in_sealed_memory() -> None:
    descriptor = table.seal(body("p"))
    try:
        assert table.read_sealed(descriptor) == body("p")
        with pytest.raises(PermissionError):
            os.pwrite(descriptor, b"x", 0)
        with pytest.raises(TableRefused) as refusal:
            table.read_sealed(descriptor, len(body("p")) - 1)
        assert refusal.value.code == "TableBusy"
    finally:
        os.close(descriptor)


def test_what_is_no_sealed_memory_is_not_read(tmp_path: Path) -> None:
    """Neither opened, nor waited for, nor read: a FIFO, a socket, a file, memory that can still change, nothing."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").write_bytes(body())
    near, far = socket.socketpair()
    wrong: list[int | None] = [None, near.detach(), far.detach(), 1 << 20]
    wrong += [os.open(tmp_path / "fifo", os.O_RDWR), os.open(tmp_path / "file", os.O_RDONLY), *os.pipe()]
    every = [fcntl.F_SEAL_SEAL, fcntl.F_SEAL_SHRINK, fcntl.F_SEAL_GROW, fcntl.F_SEAL_WRITE]
    wrong += [sealed(sum(every) - seal, body()) for seal in every]
    long = os.memfd_create("long", os.MFD_ALLOW_SEALING)
    os.truncate(long, table.MAX_TABLE_BYTES + 1)
    fcntl.fcntl(long, fcntl.F_ADD_SEALS, table.SEALED)
    for descriptor in [*wrong, long]:
        with pytest.raises(TableRefused) as refusal:
            table.read_sealed(descriptor)
        assert refusal.value.code == "CorruptFile"
        if descriptor not in (None, 1 << 20):
            os.close(int(descriptor or 0))


def test_what_is_too_long_or_finds_no_memory_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StoreError, match="stream it in pieces"):
        table.seal(bytes(table.MAX_TABLE_BYTES + 1))
    before = open_descriptors()
    monkeypatch.setattr(os, "write", refuse)
    with pytest.raises(StoreError, match="nothing was loaded"):
        table.seal(body())
    assert open_descriptors() == before


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def refuse(*_: object) -> int:
    raise OSError(12, "Cannot allocate memory")


WRONG: tuple[object, ...] = (None, -1, 1.5, [], {}, [1], "", [["X"]], True)
HEAD = {"axes": ["X"], "first": 0, "rows": 2, "final": True, "program": "p"}


@pytest.mark.parametrize(
    "head",
    [
        '{"axes": ["X"], "first": 0, "rows": Infinity, "final": true, "program": "p"}',
        '{"axes": ["X"], "first": 0, "rows": NaN, "final": true, "program": "p"}',
        '{"axes": ["X"], "first": 0, "rows": 1e999, "final": true, "program": "p"}',
        '{"axes": ["X"], "first": 0, "rows": ' + "9" * 4000 + ', "final": true, "program": "p"}',
        "[" * 4000,
        '{"axes":' * 500,
        "[" * 5000,
        "\ud800",
        "null",
        "[]",
        *(json.dumps({**HEAD, key: value}) for key in HEAD for value in WRONG),
    ],
)
@pytest.mark.fault("E3")
def test_whatever_the_header_holds_it_is_one_class(head: str) -> None:
    raw = head.encode("utf-8", "surrogatepass")
    assert decoded(struct.pack("<I", len(raw)) + raw + bytes(16)) in ("CorruptFile", (("X",), 2))


def decoded(whole: bytes) -> object:
    """The class that refuses it, or axes and rows."""
    try:
        names, path = table.decode(whole)
    except TableRefused as refusal:
        return refusal.code
    return names, path.end


def test_a_program_named_by_no_text_is_told_in_plain_letters() -> None:
    """A lone surrogate is text to JSON: it is carried along, and what is told of it can be encoded."""
    raw = json.dumps({**HEAD, "program": "\ud800"}).encode()
    _, path = table.decode(struct.pack("<I", len(raw)) + raw + bytes(16))
    assert json.dumps(path.program_digest) == '"\\ud800"'


@given(st.binary(max_size=200))
@pytest.mark.fault("F17")
def test_garbage_is_refused_by_one_class(garbage: bytes) -> None:
    with pytest.raises(TableRefused) as refusal:
        table.decode(garbage)
    assert refusal.value.code == "CorruptFile"


@pytest.mark.parametrize("cut", [1, 4, 10, 40])
def test_a_body_cut_short_is_refused(cut: int) -> None:
    with pytest.raises(TableRefused):
        table.decode(body()[:-cut])


def load(loading: table.Loading, rows: int) -> table.Loading:
    while not loading.done:
        loading.check(rows)
    return loading


def test_pieces_join_and_old_rows_are_let_go() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 10),) * 2
    path = load(table.begin(body(final=False), 1, "XY", limits, None, 0), 1).joined
    for sequence in range(2, 20):
        path = load(
            table.begin(body(first=path.end, final=sequence == 19), sequence, "XY", limits, path, path.end - 5), 3
        ).joined
        assert path.offsets_at(path.end - 1) == (3, -1)
        assert path.end - path.first <= 10 + 3 + 4
    assert path.final
    assert path.end == 4 * 19
    with pytest.raises(TableRefused, match="does not continue"):
        table.begin(body(first=path.end), 20, "XY", limits, path, 0)


@pytest.mark.parametrize(
    ("changed", "axes"),
    [({"first": 5}, "XY"), ({"first": 4, "program": "other"}, "XY"), ({}, "X"), ({}, "YX")],
)
def test_a_piece_that_does_not_belong_is_refused(changed: dict[str, object], axes: str) -> None:
    limits = (LIMITS,) * 2
    path = table.begin(body(final=False), 1, "XY", limits, None, 0).joined
    piece = table.encode("XY", ROWS, OFFSETS, str(changed.get("program", "p")), int(str(changed.get("first", 0))))
    with pytest.raises(TableRefused) as refusal:
        table.begin(piece, 2, axes, limits, path, 0)
    assert refusal.value.code == "ProgramMismatch"


def test_a_stream_begins_with_row_0() -> None:
    with pytest.raises(TableRefused, match="row 0"):
        table.begin(body(first=4), 1, "XY", (LIMITS,) * 2, None, 0)


@pytest.mark.parametrize(("row", "value", "code"), [(30, 9, "OffsetRate"), (39, 820, "OffsetLimit")])
@pytest.mark.fault("E1", "E2")
def test_rows_beyond_a_limit_are_refused_wherever_they_are(row: int, value: int, code: str) -> None:
    offsets = [0] * 40
    offsets[row] = value
    whole = table.encode("X", {"X": [0] * 40}, {"X": offsets}, "p")
    loading = table.begin(whole, 1, "X", (LIMITS,), None, 0)
    with pytest.raises(TableRefused) as refusal:
        load(loading, 7)
    assert refusal.value.code == code
    assert f"rows {row // 7 * 7} to" in str(refusal.value)


TINY = OffsetLimits(offset=10, rate=5, acceleration=2, variation=1000, window=100)


def loaded_within(travel: tuple[int, int] | None, demand: list[int]) -> CorrectedPath:
    """Load a resting table of one axis with these software limits."""
    body = table.encode("X", {"X": demand}, {"X": [0] * len(demand)}, "p")
    loading = table.begin(body, 1, ["X"], (TINY,), None, 0, (travel,))
    while not loading.done:
        loading.check(3)
    return loading.joined


@pytest.mark.parametrize("demand", [[-80, 0, 80], [-80] * 7, list(range(-80, 81))])
def test_a_path_keeps_twice_the_largest_offset_from_the_software_limits(demand: list[int]) -> None:
    assert list(loaded_within((-100, 100), demand).demand[0]) == demand
    assert list(loaded_within(None, [10**6, *demand]).demand[0]) == [10**6, *demand]


@pytest.mark.parametrize("demand", [[0, 0, 0, 0, 81], [-81, 0], [0] * 50 + [120], [-(2**31)]])
def test_a_path_that_comes_nearer_is_no_table(demand: list[int]) -> None:
    with pytest.raises(TableRefused, match="software limit") as caught:
        loaded_within((-100, 100), demand)
    assert caught.value.code == "SoftwareLimit"


def test_rows_are_little_endian_wherever_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    small = body()
    monkeypatch.setattr("sys.byteorder", "big")
    swapped = body()
    assert swapped != small
    assert list(table.decode(swapped)[1].demand[0]) == ROWS["X"]


def test_a_streamed_table_does_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Piece after piece, while nothing runs that would let the first ones go."""
    monkeypatch.setattr(table, "MAX_TABLE_BYTES", 8 * 2 * 10)
    loaded = table.begin(body("p", 0, False), 1, "XY", (TINY, TINY), None, 0).joined
    loaded = table.begin(body("p", 4, False), 2, "XY", (TINY, TINY), loaded, 0).joined
    with pytest.raises(TableRefused) as refusal:
        table.begin(body("p", 8, False), 3, "XY", (TINY, TINY), loaded, 0)
    assert refusal.value.code == "TableBusy"
