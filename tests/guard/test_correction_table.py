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
from fdhil.guard import correction_table
from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.correction_table import TableRefused
from fdhil.guard.offset_limits import OffsetLimits
from tests.guard.simulated_bus import LIMITS

ROWS = {"X": [0, 1, 3, 6], "Y": [5, 5, 5, 5]}
OFFSETS = {"X": [0, 1, 2, 3], "Y": [0, 0, -1, -1]}


def body(program: str = "p", first: int = 0, final: bool = True) -> bytes:
    return correction_table.encode_table("XY", ROWS, OFFSETS, program, first, final)


@given(
    st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1)), min_size=1, max_size=50),
    st.text(max_size=20),
    st.booleans(),
)
def test_encoded_rows_are_decoded(rows: list[tuple[int, int]], program: str, final: bool) -> None:
    demand, offset = ([row[k] for row in rows] for k in (0, 1))
    names, path = correction_table.decode_table(
        correction_table.encode_table("X", {"X": demand}, {"X": offset}, program, 3, final), 7
    )
    assert names == ("X",)
    assert [list(path.demand[0]), list(path.offset[0])] == [demand, offset]
    assert (path.first, path.end, path.final, path.program_digest) == (3, 3 + len(rows), final, program)
    assert path.sequence == 7


@pytest.mark.fault("E3")
def test_numpy_integers_are_encoded_and_floats_rejected() -> None:
    whole = correction_table.encode_table("X", {"X": np.array([1, 2], dtype=np.int64)}, {"X": np.array([0, 0])}, "p")
    assert list(correction_table.decode_table(whole)[1].demand[0]) == [1, 2]
    for wrong in ([1.0], [float("nan")], [2**31], ["1"]):
        with pytest.raises(ValueError, match="integers of 32 bits"):
            correction_table.encode_table("X", {"X": wrong}, {"X": [0]}, "p")  # type: ignore[dict-item] # what must be refused
    with pytest.raises(ValueError, match="rows"):
        correction_table.encode_table("X", {"X": [1]}, {"X": [1, 2]}, "p")


def sealed(seals: int, content: bytes = b"") -> int:
    descriptor = os.memfd_create("test", os.MFD_ALLOW_SEALING)
    os.write(descriptor, content)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
    return descriptor


def test_table_is_passed_in_sealed_memory() -> None:
    descriptor = correction_table.seal_table(body("p"))
    try:
        assert correction_table.read_sealed_memory(descriptor) == body("p")
        with pytest.raises(PermissionError):
            os.pwrite(descriptor, b"x", 0)
        assert correction_table.read_sealed_memory(descriptor, len(body("p"))) == body("p")
        assert fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) == 0b1111  # as it is, for ever
        with pytest.raises(
            TableRefused, match=r"^a table this long .* while a correction runs; disarm first$"
        ) as refusal:
            correction_table.read_sealed_memory(descriptor, len(body("p")) - 1)
        assert refusal.value.code == "TableBusy"
    finally:
        os.close(descriptor)


def test_unsealed_descriptor_is_not_read(tmp_path: Path) -> None:
    """A FIFO, a socket, a file, writable memory, nothing: neither opened nor read, and nothing waits."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "file").write_bytes(body())
    near, far = socket.socketpair()
    wrong: list[int | None] = [None, near.detach(), far.detach(), 1 << 20]
    wrong += [os.open(tmp_path / "fifo", os.O_RDWR), os.open(tmp_path / "file", os.O_RDONLY), *os.pipe()]
    every = [fcntl.F_SEAL_SEAL, fcntl.F_SEAL_SHRINK, fcntl.F_SEAL_GROW, fcntl.F_SEAL_WRITE]
    wrong += [sealed(sum(every) - seal, body()) for seal in every]
    long = os.memfd_create("long", os.MFD_ALLOW_SEALING)
    os.truncate(long, correction_table.MAX_TABLE_BYTES + 1)
    fcntl.fcntl(long, fcntl.F_ADD_SEALS, correction_table.SEALED)
    for descriptor in [*wrong, long]:
        expected = "did not come as a descriptor of sealed memory, and it was not read; load it again$"
        if descriptor == long:
            expected = (
                f"^a correction table of {correction_table.MAX_TABLE_BYTES + 1} bytes is too long; stream it in pieces$"
            )
        with pytest.raises(TableRefused, match=expected) as refusal:
            correction_table.read_sealed_memory(descriptor)
        assert refusal.value.code == "CorruptFile"
        if descriptor not in (None, 1 << 20):
            os.close(int(descriptor or 0))


def test_longest_table_is_passed_and_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(correction_table, "MAX_TABLE_BYTES", len(body()))
    descriptor = correction_table.seal_table(body())
    try:
        assert correction_table.read_sealed_memory(descriptor) == body()
    finally:
        os.close(descriptor)


def test_oversized_table_or_missing_memory_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StoreError, match="stream it in pieces"):
        correction_table.seal_table(bytes((16 << 20) + 1))
    before = open_descriptors()
    monkeypatch.setattr(os, "write", refuse)
    with pytest.raises(StoreError, match="nothing was loaded"):
        correction_table.seal_table(body())
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
def test_any_invalid_header_is_a_corrupt_file(head: str) -> None:
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
def test_corrupt_body_is_reported_with_the_next_action(changes: dict[str, object], expected: str) -> None:
    head = {**HEAD, **changes}
    raw = json.dumps(head).encode()
    whole = struct.pack("<I", len(raw)) + raw + bytes(16 if head["rows"] else 0)
    if expected:
        with pytest.raises(TableRefused) as refusal:
            correction_table.decode_table(whole)
        assert str(refusal.value) == f"the correction table cannot be read ({expected}); plan it again"
    else:
        assert correction_table.decode_table(whole)[1].first == head["first"]


def test_header_of_4096_bytes_is_accepted() -> None:
    for more in (0, 1):
        raw = json.dumps(HEAD | {"program": ""}).encode()
        raw = json.dumps(HEAD | {"program": "p" * (4096 + more - len(raw))}).encode()
        assert len(raw) == 4096 + more
        assert decoded(struct.pack("<I", len(raw)) + raw + bytes(16)) == ("CorruptFile" if more else (("X",), 2))


def decoded(whole: bytes) -> object:
    try:
        names, path = correction_table.decode_table(whole)
    except TableRefused as refusal:
        return refusal.code
    return names, path.end


def test_program_digest_that_is_not_text_is_refused() -> None:
    """JSON accepts a lone surrogate: messages that contain it must still be encodable."""
    raw = json.dumps({**HEAD, "program": "\ud800"}).encode()
    _, path = correction_table.decode_table(struct.pack("<I", len(raw)) + raw + bytes(16))
    assert json.dumps(path.program_digest) == '"\\ud800"'


@given(st.binary(max_size=200))
@pytest.mark.fault("F17")
def test_garbage_is_refused_as_corrupt(garbage: bytes) -> None:
    with pytest.raises(TableRefused) as refusal:
        correction_table.decode_table(garbage)
    assert refusal.value.code == "CorruptFile"


@pytest.mark.parametrize("cut", [1, 4, 10, 40])
def test_truncated_body_is_refused(cut: int) -> None:
    with pytest.raises(TableRefused):
        correction_table.decode_table(body()[:-cut])


def load(loading: correction_table.TableLoading, rows: int) -> correction_table.TableLoading:
    while not loading.done:
        loading.check_next_rows(rows)
    return loading


def test_pieces_are_appended_and_old_rows_dropped() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 10),) * 2
    path = load(correction_table.begin_table(body(final=False), 1, "XY", limits, None, 0), 1).joined
    for sequence in range(2, 20):
        path = load(
            correction_table.begin_table(
                body(first=path.end, final=sequence == 19), sequence, "XY", limits, path, path.end - 5
            ),
            3,
        ).joined
        assert path.get_row_offsets(path.end - 1) == (3, -1)
        assert path.end - path.first <= 10 + 3 + 4
    assert path.final
    assert path.end == 4 * 19
    with pytest.raises(TableRefused, match="does not continue"):
        correction_table.begin_table(body(first=path.end), 20, "XY", limits, path, 0)


def test_table_keeps_its_sequence_number() -> None:
    limits = (LIMITS,) * 2
    assert correction_table.decode_table(body())[1].sequence == 0
    whole = correction_table.begin_table(body(final=False), 7, "XY", limits, None, 0).joined
    assert whole.sequence == 7
    assert correction_table.begin_table(body(first=4), 8, "XY", limits, whole, 0).joined.sequence == 8
    assert correction_table.begin_renewal(body(), 9, "XY", limits, whole).joined.sequence == 9


def test_unneeded_rows_are_dropped() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 5), OffsetLimits(819, 65, 6, 9830, 2))
    rows = {"X": [0] * 40, "Y": [0] * 40}
    whole = correction_table.begin_table(
        correction_table.encode_table("XY", rows, rows, "p", 0, False), 1, "XY", limits, None, 0
    ).joined
    for keep_from, first in ((0, 0), (20, 20), (32, 32), (33, 32), (90, 32)):
        joined = correction_table.begin_table(
            correction_table.encode_table("XY", rows, rows, "p", 40, False), 2, "XY", limits, whole, keep_from
        ).joined
        assert (joined.first, joined.end) == (first, 80)
        further = correction_table.begin_table(
            correction_table.encode_table("XY", rows, rows, "p", 80), 3, "XY", limits, joined, first
        ).joined
        assert (further.first, further.end) == (first, 120)


@pytest.mark.parametrize(
    ("changed", "axes"),
    [({"first": 5}, "XY"), ({"first": 4, "program": "other"}, "XY"), ({}, "X"), ({}, "YX")],
)
def test_piece_of_another_table_is_refused(changed: dict[str, object], axes: str) -> None:
    limits = (LIMITS,) * 2
    path = correction_table.begin_table(body(final=False), 1, "XY", limits, None, 0).joined
    piece = correction_table.encode_table(
        "XY", ROWS, OFFSETS, str(changed.get("program", "p")), int(str(changed.get("first", 0)))
    )
    expected = f"^row {changed.get('first')} does not continue the loaded table; load it again$"
    if not changed:
        expected = f"^the table is for axes X, Y, not {', '.join(axes)}$"
    with pytest.raises(TableRefused, match=expected) as refusal:
        correction_table.begin_table(piece, 2, axes, limits, path, 0)
    assert refusal.value.code == "ProgramMismatch"


def test_stream_must_begin_with_row_0() -> None:
    with pytest.raises(TableRefused, match=r"^a streamed table must begin with row 0; plan it again$") as refusal:
        correction_table.begin_table(body(first=4), 1, "XY", (LIMITS,) * 2, None, 0)
    assert refusal.value.code == "ProgramMismatch"


@pytest.mark.parametrize(
    "what", [{"axes": "YX"}, {"axes": "X"}, {"first": 1}, {"program": "other"}, {"loaded": None}, {"rows": 5}]
)
def test_renewal_replaces_only_rows_of_the_same_table(what: dict[str, object]) -> None:
    limits = (LIMITS,) * 2
    loaded = None if "loaded" in what else correction_table.begin_table(body(), 1, "XY", limits, None, 0).joined
    rows = {axis: [*values, *values[:1]][: int(str(what.get("rows", 4)))] for axis, values in ROWS.items()}
    zeros = {axis: [0] * len(rows["X"]) for axis in "XY"}
    piece = correction_table.encode_table(
        "XY", rows, zeros, str(what.get("program", "p")), int(str(what.get("first", 0)))
    )
    expected = "^the rows are not the first ones of the loaded table; load it again$"
    with pytest.raises(TableRefused, match=expected) as refusal:
        correction_table.begin_renewal(piece, 2, str(what.get("axes", "XY")), limits, loaded)
    assert refusal.value.code == "ProgramMismatch"


def test_renewal_with_another_demand_is_refused() -> None:
    loaded = correction_table.begin_table(body(), 1, "XY", (LIMITS,) * 2, None, 0).joined
    other = correction_table.encode_table("XY", ROWS | {"Y": [5, 5, 5, 6]}, OFFSETS, "p")
    expected = "^the rows are those of another path than the loaded one; load it again$"
    with pytest.raises(TableRefused, match=expected) as refusal:
        correction_table.begin_renewal(other, 2, "XY", (LIMITS,) * 2, loaded)
    assert refusal.value.code == "ProgramMismatch"


def test_renewed_table_keeps_away_from_the_software_limits() -> None:
    loaded = correction_table.begin_table(body(), 1, "XY", (TINY,) * 2, None, 0).joined
    for lowest, kept in ((-20, True), (-19, False)):
        renewed = correction_table.begin_renewal(body(), 2, "XY", (TINY,) * 2, loaded, ((lowest, 100), None))
        if kept:
            assert load(renewed, 9).done
        else:
            with pytest.raises(TableRefused, match="software limit"):
                renewed.check_next_rows(9)


def test_table_without_its_first_rows_is_not_renewed() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 2),) * 2
    zeros = {"X": [0] * 9, "Y": [0] * 9}
    loaded = correction_table.begin_table(
        correction_table.encode_table("XY", zeros, zeros, "p", 0, False), 1, "XY", limits, None, 0
    ).joined
    loaded = correction_table.begin_table(
        correction_table.encode_table("XY", zeros, zeros, "p", 9, False), 2, "XY", limits, loaded, 4
    ).joined
    assert loaded.first == 4
    for first in (0, 4):
        with pytest.raises(TableRefused, match="not the first ones"):
            correction_table.begin_renewal(
                correction_table.encode_table("XY", zeros, zeros, "p", first), 3, "XY", limits, loaded
            )


def test_renewal_checks_changed_rows_and_one_second_after_them() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 5), OffsetLimits(819, 65, 6, 9830, 50))
    zeros = {"X": [0] * 40, "Y": [0] * 40}
    loaded = correction_table.begin_table(
        correction_table.encode_table("XY", zeros, zeros, "p"), 1, "XY", limits, None, 0
    ).joined
    for rows, last in ((10, 18), (32, 40), (33, 40), (40, 40)):
        first = {axis: values[:rows] for axis, values in zeros.items()}
        renewed = correction_table.begin_renewal(
            correction_table.encode_table("XY", first, first, "p"), 2, "XY", limits, loaded
        )
        assert (renewed.last, renewed.next_row, renewed.joined.end) == (last, 0, 40)
        assert load(renewed, 7).next_row == last


def test_variation_limit_covers_any_second_of_a_table() -> None:
    limits = OffsetLimits(819, 65, 60, variation=100, window=5)
    swinging = [20 * (row % 2) for row in range(30)]
    assert correction_table.check_rows(limits, swinging, 0, 30) is None
    for before in range(8):
        for travelled in (20, 21):
            offsets = [0] * before
            for move in (0, 20, -20, 20, -20, travelled):
                offsets.append((offsets or [0])[-1] + move)
            offsets += [offsets[-1]] * 8
            whole = correction_table.encode_table("X", {"X": [0] * len(offsets)}, {"X": offsets}, "p")
            for rows in (1, 3, 50):
                loading = correction_table.begin_table(whole, 1, "X", (limits,), None, 0)
                if travelled == 20:
                    assert load(loading, rows).done
                else:
                    with pytest.raises(TableRefused) as refusal:
                        load(loading, rows)
                    assert refusal.value.code == "OffsetEnergy"


def test_checked_rows_are_not_checked_again() -> None:
    jump = [0, 0, 0, 800, 800, 800, 800]
    assert correction_table.check_rows(LIMITS, jump, 0, 7) == "OffsetRate"
    assert correction_table.check_rows(LIMITS, jump, 3, 7) == "OffsetRate"
    assert correction_table.check_rows(LIMITS, jump, 5, 7) is None


@pytest.mark.parametrize(("row", "value", "code"), [(30, 9, "OffsetRate"), (39, 820, "OffsetLimit")])
@pytest.mark.fault("E1", "E2")
def test_rows_beyond_a_limit_are_refused_anywhere(row: int, value: int, code: str) -> None:
    offsets = [0] * 40
    offsets[row] = value
    whole = correction_table.encode_table("X", {"X": [0] * 40}, {"X": offsets}, "p")
    loading = correction_table.begin_table(whole, 1, "X", (LIMITS,), None, 0)
    with pytest.raises(TableRefused) as refusal:
        load(loading, 7)
    assert refusal.value.code == code
    assert f"rows {row // 7 * 7} to" in str(refusal.value)


TINY = OffsetLimits(offset=10, rate=5, acceleration=2, variation=1000, window=100)


def loaded_within(travel: tuple[int, int] | None, demand: list[int]) -> CorrectedPath:
    body = correction_table.encode_table("X", {"X": demand}, {"X": [0] * len(demand)}, "p")
    loading = correction_table.begin_table(body, 1, ["X"], (TINY,), None, 0, (travel,))
    while not loading.done:
        loading.check_next_rows(3)
    return loading.joined


@pytest.mark.parametrize("demand", [[-80, 0, 80], [-80] * 7, list(range(-80, 81))])
def test_path_keeps_twice_the_largest_offset_from_the_software_limits(demand: list[int]) -> None:
    assert list(loaded_within((-100, 100), demand).demand[0]) == demand
    assert list(loaded_within(None, [10**6, *demand]).demand[0]) == [10**6, *demand]


@pytest.mark.parametrize("demand", [[0, 0, 0, 0, 81], [-81, 0], [0] * 50 + [120], [-(2**31)]])
def test_path_too_near_to_a_software_limit_is_refused(demand: list[int]) -> None:
    expected = (
        "^the path comes nearer to a software limit of the drive than twice the largest offset; lower max_offset_um"
    )
    with pytest.raises(TableRefused, match=expected) as caught:
        loaded_within((-100, 100), demand)
    assert caught.value.code == "SoftwareLimit"


@pytest.mark.parametrize("end", [2**31 - 1 - 9, 2**31 - 1, -(2**31) + 9, -(2**31)])
def test_path_too_near_to_the_32_bit_limit_is_refused(end: int) -> None:
    """The largest offset is 10 here: one increment nearer to the end the drive would wrap around."""
    with pytest.raises(
        TableRefused, match="path comes nearer to the end of the 32-bit range than the largest"
    ) as caught:
        loaded_within(None, [0] * 5 + [end])
    assert caught.value.code == "PositionRange"


@pytest.mark.parametrize("end", [2**31 - 1 - 10, -(2**31) + 10])
def test_path_at_the_allowed_distance_from_the_32_bit_limit_is_accepted(end: int) -> None:
    assert list(loaded_within(None, [0, end]).demand[0]) == [0, end]


def test_piece_too_near_to_a_limit_is_refused() -> None:
    limits = (OffsetLimits(10, 5, 2, 1000, 2),)
    for row in (0, 1, 2, 3):
        demand = [0] * 4
        demand[row] = 81
        loaded = correction_table.begin_table(
            correction_table.encode_table("X", {"X": [90] * 9}, {"X": [0] * 9}, "p", 0, False), 1, "X", limits, None, 0
        )
        piece = correction_table.encode_table("X", {"X": demand}, {"X": [0] * 4}, "p", 9)
        loading = correction_table.begin_table(piece, 2, "X", limits, loaded.joined, 4, ((-100, 100),))
        assert loading.joined.first == 4
        for _ in range(row):
            loading.check_next_rows(1)
        with pytest.raises(TableRefused, match="software limit"):
            loading.check_next_rows(1)


def test_limit_violation_in_a_later_piece_is_found_at_its_row() -> None:
    limits = (OffsetLimits(819, 65, 6, 9830, 2),)
    loaded = correction_table.begin_table(
        correction_table.encode_table("X", {"X": [0] * 9}, {"X": [0] * 9}, "p", 0, False), 1, "X", limits, None, 0
    )
    for row in (0, 1, 2, 3):
        offsets = [0] * 4
        offsets[row] = 9
        piece = correction_table.encode_table("X", {"X": [0] * 4}, {"X": offsets}, "p", 9)
        loading = correction_table.begin_table(piece, 2, "X", limits, loaded.joined, 4)
        for _ in range(row):
            loading.check_next_rows(1)
        with pytest.raises(TableRefused, match=f"^rows {9 + row} to {10 + row} break the limit; plan"):
            loading.check_next_rows(1)


def test_rows_are_little_endian_on_any_host(monkeypatch: pytest.MonkeyPatch) -> None:
    small = body()
    monkeypatch.setattr("sys.byteorder", "big")
    swapped = body()
    assert swapped != small
    assert list(correction_table.decode_table(swapped)[1].demand[0]) == ROWS["X"]


def test_streamed_table_is_bounded_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(correction_table, "MAX_TABLE_BYTES", 8 * 2 * 10)
    loaded = correction_table.begin_table(body("p", 0, False), 1, "XY", (TINY, TINY), None, 0).joined
    loaded = correction_table.begin_table(body("p", 4, False), 2, "XY", (TINY, TINY), loaded, 0).joined
    full = "^the guard holds as many rows as it can; wait until the machine has passed some$"
    with pytest.raises(TableRefused, match=full) as refusal:
        correction_table.begin_table(body("p", 8, False), 3, "XY", (TINY, TINY), loaded, 0)
    assert refusal.value.code == "TableBusy"


def test_full_streamed_table_continues_after_rows_were_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(correction_table, "MAX_TABLE_BYTES", 8 * 2 * 8)
    limits = (OffsetLimits(819, 65, 6, 9830, 1),) * 2
    path = correction_table.begin_table(body(final=False), 1, "XY", limits, None, 0).joined
    for sequence in range(2, 9):
        path = correction_table.begin_table(
            body(first=path.end, final=False), sequence, "XY", limits, path, path.end - 4
        ).joined
        assert path.end - path.first == 8
    with pytest.raises(TableRefused, match="as many rows"):
        correction_table.begin_table(body(first=path.end), 9, "XY", limits, path, path.end - 5)
