"""The table file: what is damaged is no table, whatever byte it is."""

from __future__ import annotations

from pathlib import Path as FilePath

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.errors import StoreError
from fdhil.guard import table
from fdhil.guard.limits import Limits
from fdhil.guard.path import Path
from fdhil.guard.table import TableRefused
from tests.guard.machine import LIMITS

SLOT = 4096
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


def test_numpy_integers_are_taken_and_floats_are_not() -> None:
    whole = table.encode("X", {"X": np.array([1, 2], dtype=np.int64)}, {"X": np.array([0, 0])}, "p")
    assert list(table.decode(whole)[1].demand[0]) == [1, 2]
    for wrong in ([1.0], [float("nan")], [2**31], ["1"]):
        with pytest.raises(ValueError, match="integers of 32 bits"):
            table.encode("X", {"X": wrong}, {"X": [0]}, "p")  # type: ignore[dict-item] # what must be refused
    with pytest.raises(ValueError, match="rows"):
        table.encode("X", {"X": [1]}, {"X": [1, 2]}, "p")


def test_slots_take_turns_and_the_newest_wins(tmp_path: FilePath) -> None:
    file = tmp_path / "guard.table"
    assert table.read(file) is None
    for sequence in range(1, 6):
        assert table.write(file, body(str(sequence)), SLOT) == sequence
        assert table.read(file, 0, SLOT) == (sequence, body(str(sequence)))
        assert table.read(file, sequence, SLOT) is None


def test_every_flipped_byte_of_the_newest_slot_is_no_new_table(tmp_path: FilePath) -> None:
    file = tmp_path / "guard.table"
    table.write(file, body("old"), SLOT)
    table.write(file, body("new"), SLOT)
    good = file.read_bytes()
    for place in range(SLOT, SLOT + 20 + len(body("new"))):
        for mask in (0x01, 0x80, 0xFF):
            bad = bytearray(good)
            bad[place] ^= mask
            file.write_bytes(bad)
            assert table.read(file, 1, SLOT) is None, place
            assert table.read(file, 0, SLOT) == (1, body("old")), place
    file.write_bytes(bytes(bad))
    assert table.write(file, body("again"), SLOT) == 2  # the damaged slot is the one to be written over
    assert table.read(file, 1, SLOT) == (2, body("again"))


def test_a_table_cut_off_at_any_length_is_no_new_table(tmp_path: FilePath) -> None:
    file = tmp_path / "guard.table"
    table.write(file, body("old"), SLOT)
    table.write(file, body("new"), SLOT)
    good = file.read_bytes()
    for length in range(0, len(good), 7):
        file.write_bytes(good[:length])
        found = table.read(file, 0, SLOT)
        assert found in (None, (1, body("old")))


def test_what_does_not_fit_or_cannot_be_written_is_an_error(tmp_path: FilePath) -> None:
    with pytest.raises(StoreError, match="stream it in pieces"):
        table.write(tmp_path / "guard.table", bytes(SLOT), SLOT)
    with pytest.raises(StoreError, match="cannot be written"):
        table.write(tmp_path / "missing" / "guard.table", body(), SLOT)


@given(st.binary(max_size=200))
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
    limits = (Limits(819, 65, 6, 9830, 10),) * 2
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
def test_rows_beyond_a_limit_are_refused_wherever_they_are(row: int, value: int, code: str) -> None:
    offsets = [0] * 40
    offsets[row] = value
    whole = table.encode("X", {"X": [0] * 40}, {"X": offsets}, "p")
    loading = table.begin(whole, 1, "X", (LIMITS,), None, 0)
    with pytest.raises(TableRefused) as refusal:
        load(loading, 7)
    assert refusal.value.code == code
    assert f"rows {row // 7 * 7} to" in str(refusal.value)


TINY = Limits(offset=10, rate=5, acceleration=2, variation=1000, window=100)


def loaded_within(travel: tuple[int, int] | None, demand: list[int]) -> Path:
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
