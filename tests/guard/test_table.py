"""Correction tables: every invalid one is refused with its class."""

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
        assert table.read_sealed(descriptor, len(body("p"))) == body("p")
        assert fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) == 0b1111  # as it is, for ever
        with pytest.raises(
            TableRefused, match=r"^a table this long .* while a correction runs; disarm first$"
        ) as refusal:
            table.read_sealed(descriptor, len(body("p")) - 1)
        assert refusal.value.code == "TableBusy"
    finally:
        os.close(descriptor)


def test_what_is_no_sealed_memory_is_not_read(tmp_path: Path) -> None:
    """A FIFO, a socket, a file, writable memory, nothing: neither opened nor read, and nothing waits."""
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
        expected = "did not come as a descriptor of sealed memory, and it was not read; load it again$"
        if descriptor == long:
            expected = f"^a correction table of {table.MAX_TABLE_BYTES + 1} bytes is too long; stream it in pieces$"
        with pytest.raises(TableRefused, match=expected) as refusal:
            table.read_sealed(descriptor)
        assert refusal.value.code == "CorruptFile"
        if descriptor not in (None, 1 << 20):
            os.close(int(descriptor or 0))


def test_the_longest_table_is_handed_over_and_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "MAX_TABLE_BYTES", len(body()))
    descriptor = table.seal(body())
    try:
        assert table.read_sealed(descriptor) == body()
    finally:
        os.close(descriptor)


def test_what_is_too_long_or_finds_no_memory_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StoreError, match="stream it in pieces"):
        table.seal(bytes((16 << 20) + 1))
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


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"rows": 1.5}, "its header counts no rows, or names no program"),
        ({"first": -1}, "its header counts no rows, or names no program"),
        ({"first": 1 << 31}, "its header counts no rows, or names no program"),
        ({"program": 7}, "its header counts no rows, or names no program"),
        ({"axes": "X"}, "its header names no axes"),
        ({"axes": [1]}, "its header names no axes"),
        ({"rows": 3}, "16 bytes are not 2 columns of 3 rows"),
        ({"axes": []}, "16 bytes are not 0 columns of 2 rows"),
        ({"axes": [], "rows": 0}, "0 bytes are not 0 columns of 0 rows"),
        ({"rows": 0}, "0 bytes are not 2 columns of 0 rows"),
        ({"first": (1 << 31) - 1}, ""),
        ({"program": "p" * 4000}, ""),
        ({"program": "p" * 4096}, "its header is too long"),
    ],
)
def test_what_is_wrong_with_a_body_is_told_and_what_to_do(changes: dict[str, object], expected: str) -> None:
    head = {**HEAD, **changes}
    raw = json.dumps(head).encode()
    whole = struct.pack("<I", len(raw)) + raw + bytes(16 if head["rows"] else 0)
    if expected:
        with pytest.raises(TableRefused) as refusal:
            table.decode(whole)
        assert str(refusal.value) == f"the correction table cannot be read ({expected}); plan it again"
    else:
        assert table.decode(whole)[1].first == head["first"]


def test_a_header_may_have_4096_bytes() -> None:
    for more in (0, 1):
        raw = json.dumps(HEAD | {"program": ""}).encode()
        raw = json.dumps(HEAD | {"program": "p" * (4096 + more - len(raw))}).encode()
        assert len(raw) == 4096 + more
        assert decoded(struct.pack("<I", len(raw)) + raw + bytes(16)) == ("CorruptFile" if more else (("X",), 2))


def decoded(whole: bytes) -> object:
    try:
        names, path = table.decode(whole)
    except TableRefused as refusal:
        return refusal.code
    return names, path.end


def test_a_program_named_by_no_text_is_told_in_plain_letters() -> None:
    """JSON accepts a lone surrogate: messages that contain it must still be encodable."""
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


def test_a_table_has_the_number_under_which_it_came() -> None:
    limits = (LIMITS,) * 2
    assert table.decode(body())[1].sequence == 0
    whole = table.begin(body(final=False), 7, "XY", limits, None, 0).joined
    assert whole.sequence == 7
    assert table.begin(body(first=4), 8, "XY", limits, whole, 0).joined.sequence == 8
    assert table.renew(body(), 9, "XY", limits, whole).joined.sequence == 9


def test_rows_are_let_go_that_no_check_and_no_machine_needs_any_more() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 5), OffsetLimits(819, 65, 6, 9830, 2))
    rows = {"X": [0] * 40, "Y": [0] * 40}
    whole = table.begin(table.encode("XY", rows, rows, "p", 0, False), 1, "XY", limits, None, 0).joined
    for keep_from, first in ((0, 0), (20, 20), (32, 32), (33, 32), (90, 32)):
        joined = table.begin(table.encode("XY", rows, rows, "p", 40, False), 2, "XY", limits, whole, keep_from).joined
        assert (joined.first, joined.end) == (first, 80)
        further = table.begin(table.encode("XY", rows, rows, "p", 80), 3, "XY", limits, joined, first).joined
        assert (further.first, further.end) == (first, 120)


@pytest.mark.parametrize(
    ("changed", "axes"),
    [({"first": 5}, "XY"), ({"first": 4, "program": "other"}, "XY"), ({}, "X"), ({}, "YX")],
)
def test_a_piece_that_does_not_belong_is_refused(changed: dict[str, object], axes: str) -> None:
    limits = (LIMITS,) * 2
    path = table.begin(body(final=False), 1, "XY", limits, None, 0).joined
    piece = table.encode("XY", ROWS, OFFSETS, str(changed.get("program", "p")), int(str(changed.get("first", 0))))
    expected = f"^row {changed.get('first')} does not continue the loaded table; load it again$"
    if not changed:
        expected = f"^the table is for axes X, Y, not {', '.join(axes)}$"
    with pytest.raises(TableRefused, match=expected) as refusal:
        table.begin(piece, 2, axes, limits, path, 0)
    assert refusal.value.code == "ProgramMismatch"


def test_a_stream_begins_with_row_0() -> None:
    with pytest.raises(TableRefused, match=r"^a streamed table must begin with row 0; plan it again$") as refusal:
        table.begin(body(first=4), 1, "XY", (LIMITS,) * 2, None, 0)
    assert refusal.value.code == "ProgramMismatch"


@pytest.mark.parametrize(
    "what", [{"axes": "YX"}, {"axes": "X"}, {"first": 1}, {"program": "other"}, {"loaded": None}, {"rows": 5}]
)
def test_first_rows_take_the_place_of_those_of_the_same_table_alone(what: dict[str, object]) -> None:
    limits = (LIMITS,) * 2
    loaded = None if "loaded" in what else table.begin(body(), 1, "XY", limits, None, 0).joined
    rows = {axis: [*values, *values[:1]][: int(str(what.get("rows", 4)))] for axis, values in ROWS.items()}
    zeros = {axis: [0] * len(rows["X"]) for axis in "XY"}
    piece = table.encode("XY", rows, zeros, str(what.get("program", "p")), int(str(what.get("first", 0))))
    expected = "^the rows are not the first ones of the loaded table; load it again$"
    with pytest.raises(TableRefused, match=expected) as refusal:
        table.renew(piece, 2, str(what.get("axes", "XY")), limits, loaded)
    assert refusal.value.code == "ProgramMismatch"


def test_first_rows_of_another_way_are_those_of_another_path() -> None:
    loaded = table.begin(body(), 1, "XY", (LIMITS,) * 2, None, 0).joined
    other = table.encode("XY", ROWS | {"Y": [5, 5, 5, 6]}, OFFSETS, "p")
    expected = "^the rows are those of another path than the loaded one; load it again$"
    with pytest.raises(TableRefused, match=expected) as refusal:
        table.renew(other, 2, "XY", (LIMITS,) * 2, loaded)
    assert refusal.value.code == "ProgramMismatch"


def test_a_renewed_table_keeps_away_from_the_software_limits_too() -> None:
    loaded = table.begin(body(), 1, "XY", (TINY,) * 2, None, 0).joined
    for lowest, kept in ((-20, True), (-19, False)):
        renewed = table.renew(body(), 2, "XY", (TINY,) * 2, loaded, ((lowest, 100), None))
        if kept:
            assert load(renewed, 9).done
        else:
            with pytest.raises(TableRefused, match="software limit"):
                renewed.check(9)


def test_a_table_whose_first_rows_are_gone_is_not_renewed() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 2),) * 2
    zeros = {"X": [0] * 9, "Y": [0] * 9}
    loaded = table.begin(table.encode("XY", zeros, zeros, "p", 0, False), 1, "XY", limits, None, 0).joined
    loaded = table.begin(table.encode("XY", zeros, zeros, "p", 9, False), 2, "XY", limits, loaded, 4).joined
    assert loaded.first == 4
    for first in (0, 4):
        with pytest.raises(TableRefused, match="not the first ones"):
            table.renew(table.encode("XY", zeros, zeros, "p", first), 3, "XY", limits, loaded)


def test_of_a_renewed_table_the_rows_are_checked_that_may_differ_and_a_second_behind_them() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 5), OffsetLimits(819, 65, 6, 9830, 50))
    zeros = {"X": [0] * 40, "Y": [0] * 40}
    loaded = table.begin(table.encode("XY", zeros, zeros, "p"), 1, "XY", limits, None, 0).joined
    for rows, last in ((10, 18), (32, 40), (33, 40), (40, 40)):
        first = {axis: values[:rows] for axis, values in zeros.items()}
        renewed = table.renew(table.encode("XY", first, first, "p"), 2, "XY", limits, loaded)
        assert (renewed.last, renewed.next_row, renewed.joined.end) == (last, 0, 40)
        assert load(renewed, 7).next_row == last


def test_a_second_of_travel_may_be_all_that_is_allowed_wherever_it_begins() -> None:
    limits = OffsetLimits(819, 65, 60, variation=100, window=5)
    swinging = [20 * (row % 2) for row in range(30)]
    assert table.check_rows(limits, swinging, 0, 30) is None
    for before in range(8):
        for travelled in (20, 21):
            offsets = [0] * before
            for move in (0, 20, -20, 20, -20, travelled):
                offsets.append((offsets or [0])[-1] + move)
            offsets += [offsets[-1]] * 8
            whole = table.encode("X", {"X": [0] * len(offsets)}, {"X": offsets}, "p")
            for rows in (1, 3, 50):
                loading = table.begin(whole, 1, "X", (limits,), None, 0)
                if travelled == 20:
                    assert load(loading, rows).done
                else:
                    with pytest.raises(TableRefused) as refusal:
                        load(loading, rows)
                    assert refusal.value.code == "OffsetEnergy"


def test_rows_that_were_checked_are_not_checked_again() -> None:
    jump = [0, 0, 0, 800, 800, 800, 800]
    assert table.check_rows(LIMITS, jump, 0, 7) == "OffsetRate"
    assert table.check_rows(LIMITS, jump, 3, 7) == "OffsetRate"
    assert table.check_rows(LIMITS, jump, 5, 7) is None


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
    expected = (
        "^the path comes nearer to a software limit of the drive than twice the largest offset; lower max_offset_um"
    )
    with pytest.raises(TableRefused, match=expected) as caught:
        loaded_within((-100, 100), demand)
    assert caught.value.code == "SoftwareLimit"


@pytest.mark.parametrize("end", [2**31 - 1 - 9, 2**31 - 1, -(2**31) + 9, -(2**31)])
def test_no_offset_on_a_path_leaves_32_bits(end: int) -> None:
    """The largest offset is 10 here: one increment nearer to the end the drive would wrap around."""
    with pytest.raises(
        TableRefused, match="path comes nearer to the end of the 32-bit range than the largest"
    ) as caught:
        loaded_within(None, [0] * 5 + [end])
    assert caught.value.code == "PositionRange"


@pytest.mark.parametrize("end", [2**31 - 1 - 10, -(2**31) + 10])
def test_a_path_up_to_the_largest_offset_from_the_end_of_32_bits_is_a_table(end: int) -> None:
    assert list(loaded_within(None, [0, end]).demand[0]) == [0, end]


def test_a_piece_that_comes_nearer_is_no_part_of_a_table() -> None:
    limits = (OffsetLimits(10, 5, 2, 1000, 2),)
    for row in (0, 1, 2, 3):
        demand = [0] * 4
        demand[row] = 81
        loaded = table.begin(table.encode("X", {"X": [90] * 9}, {"X": [0] * 9}, "p", 0, False), 1, "X", limits, None, 0)
        piece = table.encode("X", {"X": demand}, {"X": [0] * 4}, "p", 9)
        loading = table.begin(piece, 2, "X", limits, loaded.joined, 4, ((-100, 100),))
        assert loading.joined.first == 4
        for _ in range(row):
            loading.check(1)
        with pytest.raises(TableRefused, match="software limit"):
            loading.check(1)


def test_an_offset_that_breaks_a_limit_in_a_later_piece_is_found_at_its_row() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 2),)
    loaded = table.begin(table.encode("X", {"X": [0] * 9}, {"X": [0] * 9}, "p", 0, False), 1, "X", limits, None, 0)
    for row in (0, 1, 2, 3):
        offsets = [0] * 4
        offsets[row] = 9
        piece = table.encode("X", {"X": [0] * 4}, {"X": offsets}, "p", 9)
        loading = table.begin(piece, 2, "X", limits, loaded.joined, 4)
        for _ in range(row):
            loading.check(1)
        with pytest.raises(TableRefused, match=f"^rows {9 + row} to {10 + row} break the limit; plan"):
            loading.check(1)


def test_rows_are_little_endian_wherever_they_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    small = body()
    monkeypatch.setattr("sys.byteorder", "big")
    swapped = body()
    assert swapped != small
    assert list(table.decode(swapped)[1].demand[0]) == ROWS["X"]


def test_a_streamed_table_does_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "MAX_TABLE_BYTES", 8 * 2 * 10)
    loaded = table.begin(body("p", 0, False), 1, "XY", (TINY, TINY), None, 0).joined
    loaded = table.begin(body("p", 4, False), 2, "XY", (TINY, TINY), loaded, 0).joined
    full = "^the guard holds as many rows as it can; wait until the machine has passed some$"
    with pytest.raises(TableRefused, match=full) as refusal:
        table.begin(body("p", 8, False), 3, "XY", (TINY, TINY), loaded, 0)
    assert refusal.value.code == "TableBusy"


def test_a_streamed_table_may_fill_what_there_is_and_goes_on_where_rows_were_let_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(table, "MAX_TABLE_BYTES", 8 * 2 * 8)
    limits = (OffsetLimits(819, 65, 6, 9830, 1),) * 2
    path = table.begin(body(final=False), 1, "XY", limits, None, 0).joined
    for sequence in range(2, 9):
        path = table.begin(body(first=path.end, final=False), sequence, "XY", limits, path, path.end - 4).joined
        assert path.end - path.first == 8
    with pytest.raises(TableRefused, match="as many rows"):
        table.begin(body(first=path.end), 9, "XY", limits, path, path.end - 5)
