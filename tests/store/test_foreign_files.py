"""MATLAB, MDF, HDF5 and Parquet files of other programs become recordings by a column map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py  # on import it starts a process, which no test of the fast tier may
import numpy as np
import pytest

from fdhil.errors import RecordingError
from fdhil.records import Float
from fdhil.store import recording_hdf5, recording_mat, recording_mdf4, recording_parquet
from fdhil.store.column_map import ColumnMap, apply_column_map
from fdhil.store.recording_file import read_table
from fdhil.store.recording_table import IMPORT_NOTES, RecordingTable, make_recording

N = 60
TIME = np.arange(N * 1.0) * 1e-3
BELL = np.sin(np.pi * np.arange(N) / (N - 1)) ** 2
VALUES: Mapping[str, Float] = {"u": 90 * BELL, "i": 12 * BELL + 1, "w": 120 * BELL, "x": 0.4 * BELL, "r": 0.41 * BELL}
LETTERS = {"time_s": ("t", "s"), "voltage_V": ("u", "V"), "current_A": ("i", "A"), "speed_rad_per_s": ("w", "rad/s"),
           "position_m": ("x", "m"), "demand_m": ("r", "m")}  # fmt: skip


READERS = {
    ".mat": recording_mat.read,
    ".h5": recording_hdf5.read,
    ".mf4": recording_mdf4.read,
    ".parquet": recording_parquet.decode,
}


def _make_map(names: Mapping[str, str] | None = None, rate_hz: float | None = None, time: bool = True) -> ColumnMap:
    headers: dict[str, Any] = {"axis": "X", "pitch_m_per_rev": 0.02, "voltage_sampling": "instant"}
    headers |= {} if rate_hz is None else {"sample_rate_hz": rate_hz}
    columns = {
        signal: {"name": (names or {}).get(name, name), "unit": unit} for signal, (name, unit) in LETTERS.items()
    }
    if not time:
        del columns["time_s"]
    return ColumnMap.model_validate({"headers": headers, "columns": columns})


def _make_table(path: Path, told: ColumnMap) -> RecordingTable:
    return apply_column_map(READERS[path.suffix](path.read_bytes(), path.name), told, path.name)


def _assert_is_read(path: Path, told: ColumnMap, lost: tuple[int, ...] = ()) -> None:
    read = _make_table(path, told)
    kept = np.delete(np.arange(N), lost)
    for signal, (name, _) in LETTERS.items():
        expected = TIME if name == "t" else VALUES[name]
        np.testing.assert_allclose(read.columns[signal], expected[kept], atol=1e-9, err_msg=signal)


def _make_matlab_5(path: Path, variables: Mapping[str, Any]) -> None:
    from scipy import io

    io.savemat(path, dict(variables))


def _write_dataset(group: Any, name: str, value: Any) -> Any:
    if isinstance(value, dict):
        group = group.create_group(name)
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, part in value.items():
            _write_dataset(group, key, part)
        return group
    if isinstance(value, list):  # an array of structures: references by field
        group, root = group.create_group(name), group.file.require_group("#refs#")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for key in value[0]:
            stored = group.create_dataset(key, (len(value), 1), dtype=h5py.ref_dtype)
            stored[:, 0] = [_write_dataset(root, f"{key}{k}", part[key]).ref for k, part in enumerate(value)]
        return group
    is_text = isinstance(value, str)
    numbers = np.array([[ord(c)] for c in value], "u2") if is_text else np.atleast_2d(value.T)
    stored = group.create_dataset(name, data=numbers)
    stored.attrs["MATLAB_class"] = np.bytes_("char" if is_text else "double")
    return stored


def _make_matlab_73(path: Path, variables: Mapping[str, Any]) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _write_dataset(file, name, value)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + b"\0" * 8 + b"\0\2IM")


SCOPE: dict[str, Any] = {
    "time": TIME,
    "signals": [{"values": v, "label": name} for name, v in VALUES.items()],
    "blockName": "axis",
}
MATRIX = {name: f"data(:,{k})" for k, name in enumerate("tuiwxr", 1)}
# layout of a MATLAB file -> its variables, and the names of a map
LAYOUTS: dict[str, tuple[Mapping[str, Any], Mapping[str, str]]] = {
    "vectors": ({"t": TIME, **VALUES}, {}),
    "a structure": ({"meas": {"t": TIME, **VALUES}}, {}),
    "a structure by its full names": (
        {"meas": {"t": TIME, **VALUES}, "old": {"t": TIME, **VALUES}},
        {name: f"meas.{name}" for name in "tuiwxr"},
    ),
    "structures in structures": ({"rec": {"X": {"t": TIME, **VALUES}}}, {"t": "rec.X.t"}),
    "a matrix": ({"data": np.column_stack([TIME, *VALUES.values()])}, MATRIX),
    "a scope by its labels": ({"ScopeData": SCOPE}, {"t": "ScopeData.time"}),
    "a scope by its places": (
        {"ScopeData": SCOPE},
        {"t": "time", **{name: f"ScopeData.signals({k}).values" for k, name in enumerate(VALUES, 1)}},
    ),
}


@pytest.mark.parametrize("write", [_make_matlab_5, _make_matlab_73])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_matlab_file_is_read_by_matlab_names(layout: str, write: Any, tmp_path: Path) -> None:
    variables, names = LAYOUTS[layout]
    write(tmp_path / "r.mat", variables)
    _assert_is_read(tmp_path / "r.mat", _make_map(names))


@pytest.mark.parametrize("write", [_make_matlab_5, _make_matlab_73])
def test_scope_has_own_time_and_labelled_signal(write: Any, tmp_path: Path) -> None:
    write(tmp_path / "r.mat", {"ScopeData": SCOPE})
    _assert_is_read(tmp_path / "r.mat", _make_map(time=False))
    wide = {"time": TIME, "signals": {"values": np.column_stack([*VALUES.values()]), "label": "all"}}
    write(tmp_path / "wide.mat", {"ScopeData": wide})
    _assert_is_read(tmp_path / "wide.mat", _make_map({n: f"all(:,{k})" for k, n in enumerate(VALUES, 1)}, time=False))
    deep = {"time": TIME, "signals": {"values": np.array([*VALUES.values()])[:, None, :], "label": "all"}}
    write(tmp_path / "deep.mat", {"ScopeData": deep})
    _assert_is_read(tmp_path / "deep.mat", _make_map({n: f"all({k},:)" for k, n in enumerate(VALUES, 1)}, time=False))


def test_ambiguous_label_is_refused(tmp_path: Path) -> None:
    signals = [*SCOPE["signals"], {"values": TIME, "label": "u"}]
    _make_matlab_5(tmp_path / "r.mat", {"ScopeData": {**SCOPE, "signals": signals}})
    with pytest.raises(
        RecordingError, match=r"'u' stands for ScopeData.signals\(1\).values and ScopeData.signals\(6\)"
    ):
        _make_table(tmp_path / "r.mat", _make_map(time=False))


def test_headers_of_matlab_7_3_file_are_read(tmp_path: Path) -> None:
    headers = {"format": "fdhil-recording-1", "axis": "Y", "sample_rate_hz": np.array([1000.0]),
               "pitch_m_per_rev": "0.02", "voltage_sampling": "instant"}  # fmt: skip
    columns = {signal: TIME if name == "t" else VALUES[name] for signal, (name, _) in LETTERS.items()}
    _make_matlab_73(tmp_path / "r.mat", {"headers": headers, **columns})
    read = make_recording(recording_mat.read((tmp_path / "r.mat").read_bytes(), "r.mat"))
    assert (read.axis, read.dt_s, read.time_s.size) == ("Y", 0.001, N)


@pytest.mark.parametrize("write", [_make_matlab_5, _make_matlab_73])
@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"meas": {"t": TIME, **VALUES, "u": VALUES["u"][1:]}}, "different lengths.*'voltage_V': 59"),
        ({"data": np.column_stack([TIME, *VALUES.values()])}, r"no column 't'; it has 'data\(:,1\)'"),
        ({"a": {"t": TIME, **VALUES}, "b": {"t": TIME}}, "'t' stands for a.t and b.t"),
        ({"note": "nothing else"}, "it has no columns of numbers"),
    ],
)
def test_missing_content_of_matlab_file_is_named(variables: Any, words: str, write: Any, tmp_path: Path) -> None:
    write(tmp_path / "r.mat", variables)
    with pytest.raises(RecordingError, match=words):
        _make_table(tmp_path / "r.mat", _make_map())


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    _make_matlab_5(tmp_path / "r.mat", {"t": TIME, **VALUES, "i": VALUES["i"] + 1j})
    with pytest.raises(RecordingError, match="'i' is not a vector of real numbers"):
        _make_table(tmp_path / "r.mat", _make_map())


def test_matrices_and_tables_of_hdf5_have_columns(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["data"] = np.column_stack([TIME, *VALUES.values()])
        table = np.zeros(N, [(name, "f8") for name in "tuiwxr"])
        for name, values in zip("tuiwxr", [TIME, *VALUES.values()], strict=True):
            table[name] = values
        file["run/table"] = table
    _assert_is_read(tmp_path / "r.h5", _make_map({name: f"data[:,{k}]" for k, name in enumerate("tuiwxr")}))
    _assert_is_read(tmp_path / "r.h5", _make_map({name: f"run/table/{name}" for name in "tuiwxr"}))


def _make_mdf(path: Path, *groups: tuple[Float, Mapping[str, Float]], invalid: tuple[int, ...] = ()) -> None:
    import asammdf

    with asammdf.MDF(version="4.10") as file:
        for time_s, channels in groups:
            bits = np.isin(np.arange(time_s.size), invalid)
            signals = [
                asammdf.Signal(v, time_s, name=name, invalidation_bits=bits if invalid and name == "i" else None)
                for name, v in channels.items()
            ]
            file.append(signals, common_timebase=True)
        file.save(path)


FINE = np.arange(10.0 * N) * 1e-4
FAST: Mapping[str, Float] = {name: np.interp(FINE, TIME, values) for name, values in VALUES.items()}
GROUPS: dict[str, list[tuple[Float, Mapping[str, Float]]]] = {
    "one": [(TIME, VALUES)],
    "a larger one": [(FINE, {"vibration": FINE}), (TIME, VALUES)],
    "one name again": [(FINE, {"u": FINE}), (TIME, VALUES)],
    "a channel each": [(TIME, {name: values}) for name, values in VALUES.items()],
}


@pytest.mark.parametrize("groups", GROUPS)
def test_mdf_group_with_the_columns_is_read(groups: str, tmp_path: Path) -> None:
    _make_mdf(tmp_path / "r.mf4", *GROUPS[groups])
    _assert_is_read(tmp_path / "r.mf4", _make_map(time=False))


def test_contradicting_unit_of_mdf_channel_is_refused(tmp_path: Path) -> None:
    import asammdf

    with asammdf.MDF(version="4.10") as file:
        units = {"i": "mA"}
        file.append([asammdf.Signal(v, TIME, name=n, unit=units.get(n, "")) for n, v in VALUES.items()])
        file.save(tmp_path / "r.mf4")
    with pytest.raises(RecordingError, match="'i' in mA, the column map has A"):
        _make_table(tmp_path / "r.mf4", _make_map(time=False))


def test_contradicting_unit_of_dataset_is_refused(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    with h5py.File(tmp_path / "r.h5", "w") as file:
        for name, values in {"t": TIME, **VALUES}.items():
            file[name] = values
        file["i"].attrs["Units"] = "mA"
    table = pa.table({"t": TIME, **VALUES})
    fields = [field.with_metadata({"unit": "mA"}) if field.name == "i" else field for field in table.schema]
    pq.write_table(table.cast(pa.schema(fields)), tmp_path / "r.parquet")
    for name in ("r.h5", "r.parquet"):
        with pytest.raises(RecordingError, match="'i' in mA, the column map has A"):
            _make_table(tmp_path / name, _make_map())


@pytest.mark.parametrize("kind", [{"sync_type": 2}, {"sync_type": 0, "channel_type": 0}])
def test_mdf_group_without_time_master_is_refused(kind: Mapping[str, int], tmp_path: Path) -> None:
    import asammdf

    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(v, TIME, name=n) for n, v in VALUES.items()], common_timebase=True)
        for key, value in kind.items():
            setattr(file.groups[0].channels[0], key, value)
        file.save(tmp_path / "r.mf4")
    with pytest.raises(RecordingError, match="'time_s' is not a time"):
        _make_table(tmp_path / "r.mf4", _make_map(time=False))
    _assert_is_read(tmp_path / "r.mf4", _make_map(rate_hz=1000.0, time=False))


def test_invalid_samples_of_mdf_file_are_gaps(tmp_path: Path) -> None:
    _make_mdf(tmp_path / "r.mf4", (TIME, VALUES), invalid=(20, 21, 22))
    _assert_is_read(tmp_path / "r.mf4", _make_map(time=False), lost=(20, 21, 22))


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ([(TIME, VALUES), (FINE, FAST)], "in 2 groups of samples"),
        ([(TIME, {n: v for n, v in VALUES.items() if n != "u"}), (FINE, {"u": FINE})], "no group with all of"),
        ([(TIME, {n: v for n, v in VALUES.items() if n != "u"})], "no column 'u'; it has 'time_s', 'time', 'i'"),
    ],
)
def test_ambiguous_mdf_groups_are_refused(groups: Any, words: str, tmp_path: Path) -> None:
    _make_mdf(tmp_path / "r.mf4", *groups)
    with pytest.raises(RecordingError, match=words):
        _make_table(tmp_path / "r.mf4", _make_map(time=False))


def _make_times() -> dict[str, Any]:
    import pyarrow as pa

    ns = np.rint(TIME * 1e9).astype(np.int64)
    return {
        "duration[ns]": pa.array(ns, pa.duration("ns")),
        "duration[ms]": pa.array(ns // 10**6, pa.duration("ms")),
        "timestamp[us, UTC]": pa.array(ns // 1000 + 1_741_169_723_000_000, pa.timestamp("us", "UTC")),
        "time32[ms]": pa.array((ns // 10**6).astype(np.int32), pa.time32("ms")),
        "past midnight": pa.array(((ns // 10**6 + 86_399_980) % 86_400_000).astype(np.int32), pa.time32("ms")),
        "time64[ns]": pa.array(ns + 3_600_000_000_000, pa.time64("ns")),
        "double": pa.array(TIME),
    }


@pytest.mark.parametrize(
    "kind",
    ["duration[ns]", "duration[ms]", "timestamp[us, UTC]", "time32[ms]", "past midnight", "time64[ns]", "double"],
)
def test_every_time_type_of_parquet_is_read(kind: str, tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"t": _make_times()[kind], **VALUES}), tmp_path / "r.parquet")
    _assert_is_read(tmp_path / "r.parquet", _make_map())
    pq.write_table(pa.table({"time_s": _make_times()[kind], **VALUES}), tmp_path / "own.parquet")
    _assert_is_read(tmp_path / "own.parquet", _make_map(time=False))


def test_time_cannot_be_another_signal() -> None:
    table = RecordingTable({}, {"t": TIME, **VALUES}, frozenset({"t", "i"}))
    with pytest.raises(RecordingError, match="'i' is a time, not current_A"):
        apply_column_map(table, _make_map(), "trace")


def test_structures_and_nulls_of_parquet_are_columns_and_gaps(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    lost = [None if k in (20, 21) else value for k, value in enumerate(VALUES["u"].tolist())]
    parts = {**VALUES, "u": lost}
    meas = pa.StructArray.from_arrays([pa.array(part) for part in parts.values()], [*parts])
    pq.write_table(pa.table({"t": TIME, "meas": meas}), tmp_path / "r.parquet")
    _assert_is_read(tmp_path / "r.parquet", _make_map({name: f"meas.{name}" for name in VALUES}), lost=(20, 21))


def test_text_column_of_parquet_is_refused_with_its_type(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"t": [str(t) for t in TIME], **VALUES}), tmp_path / "r.parquet")
    with pytest.raises(RecordingError, match="'t' is of type string"):
        _make_table(tmp_path / "r.parquet", _make_map())


@pytest.mark.parametrize(
    ("rate_hz", "interruption", "words"),
    [
        (None, "", "name the column of time_s in the column map, or give sample_rate_hz"),
        (1000.0, "line 9 between the rows is no row", "number of lost samples is unknown"),
        (-1.0, "", "sample_rate_hz of the column map must be a number above 0"),
    ],
)
def test_rows_without_time_need_rate_and_no_interruption(rate_hz: float | None, interruption: str, words: str) -> None:
    table = RecordingTable({}, VALUES, interruption=interruption)
    with pytest.raises(RecordingError, match=words):
        apply_column_map(table, _make_map(rate_hz=rate_hz, time=False), "trace")
    read = apply_column_map(RecordingTable({}, VALUES), _make_map(rate_hz=1000.0, time=False), "trace")
    np.testing.assert_allclose(read.columns["time_s"], TIME)


def test_unwrapped_counter_is_noted_in_headers() -> None:
    counts = np.rint(30_000 + 4e4 * VALUES["x"])
    wrapped = (counts + 32768) % 65536 - 32768
    read = apply_column_map(RecordingTable({}, {"t": TIME, **VALUES, "x": wrapped}), _make_map(), "trace")
    assert np.array_equal(read.columns["position_m"], counts)
    assert read.headers[IMPORT_NOTES] == "x wraps like a counter of 16 bits and was unwrapped"


def test_two_names_of_one_column_are_refused() -> None:
    table = RecordingTable({}, {"t": TIME, **VALUES, "r": VALUES["x"]})
    with pytest.raises(RecordingError, match="'x' and 'r' above one column"):
        apply_column_map(table, _make_map(), "trace")


@pytest.mark.usefixtures("processes")
def test_reading_process_returns_all_columns(tmp_path: Path) -> None:
    _make_mdf(tmp_path / "r.mf4", *GROUPS["one name again"], invalid=(20,))
    through, direct = (
        read_table(tmp_path / "r.mf4", _make_map(time=False)),
        _make_table(tmp_path / "r.mf4", _make_map(time=False)),
    )
    assert dict(through.headers) == dict(direct.headers)
    for name, values in direct.columns.items():
        assert np.array_equal(through.columns[name], values)
    _make_matlab_5(tmp_path / "r.mat", {"a": {"t": TIME, **VALUES}, "b": {"t": TIME}})
    with pytest.raises(RecordingError, match=r"'t' stands for a\.t and b\.t"):
        read_table(tmp_path / "r.mat", _make_map())


def test_position_within_one_turn_is_unwrapped_or_refused() -> None:
    slope = {**VALUES, "x": np.fmod(TIME, 0.02)}
    read = apply_column_map(RecordingTable({}, {"t": TIME, **slope}), _make_map(), "trace")
    np.testing.assert_allclose(read.columns["position_m"], np.arange(N) * 1e-3, atol=1e-9)
    assert "x wraps at each turn of the screw" in read.headers[IMPORT_NOTES]
    other = {**VALUES, "x": np.fmod(TIME, 0.03)}
    with pytest.raises(RecordingError, match=r"'x' jumps by 0.029, .* one turn is 0.02 by the column map"):
        apply_column_map(RecordingTable({}, {"t": TIME, **other}), _make_map(), "trace")


def test_wrong_unit_of_time_is_refused() -> None:
    for factor, lasts in (
        (1e-3, "5.9e-05"),
        (1 / 86400, "6.83e-07"),
    ):  # seconds where ms are said; days of a spreadsheet
        with pytest.raises(RecordingError, match=rf"lasts only {lasts} s by its times.*correct the unit of time_s"):
            apply_column_map(RecordingTable({}, {"t": TIME * factor, **VALUES}), _make_map(), "trace")
