"""Recordings as CSV: what is read, and what is refused in one sentence."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fdhil import csv_text
from fdhil.errors import RecordingError
from fdhil.store.recording_csv import parse_recording
from fdhil.store.recording_file import read_recording
from studies import bench

COLUMNS = ("voltage_V", "current_A", "speed_rad_per_s", "position_m", "demand_m")


def _make_text(rows: int = 40, **headers: str) -> str:
    values = np.linspace(0.0, rows * 0.5, rows, endpoint=False)
    return bench.format_table(0.001, dict.fromkeys(COLUMNS, values), **headers)


def _remove_header(text: str, start: str) -> str:
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith(start))


def test_units_and_headers_are_read(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text(_make_text(temperature_C="21.5", machine="mill 3"))
    recording = read_recording(path)
    assert recording.axis == "X"
    assert recording.dt_s == pytest.approx(0.001)
    assert recording.pitch_mm == pytest.approx(20.0)
    assert recording.rapid_speed_rad_s == pytest.approx(0.5 / 0.02 * 2 * math.pi)
    assert recording.temperature_c == 21.5
    assert recording.headers["machine"] == "mill 3"
    assert recording.position_mm[2] == pytest.approx(1000.0)
    assert recording.gaps == ()
    assert not recording.speed_rad_s.flags.writeable


def test_columns_are_read_in_any_order() -> None:
    columns: dict[str, bench.Array] = {name: np.linspace(0.0, 29.0, 30) for name in ("extra", *reversed(COLUMNS))}
    columns["current_A"] = np.linspace(0.0, 87.0, 30)
    recording = parse_recording(bench.format_table(0.001, columns))
    assert recording.current_a[2] == 6.0


def test_missing_row_is_a_gap_of_nan() -> None:
    lines = _make_text().splitlines(keepends=True)
    first = next(k for k, line in enumerate(lines) if line.startswith("time_s")) + 1
    del lines[first + 10 : first + 13]
    recording = parse_recording("".join(lines))
    assert recording.gaps == ((10, 13),)
    assert recording.time_s.size == 40
    assert np.isnan(recording.speed_rad_s[10:13]).all()
    assert recording.speed_rad_s[13] == 6.5


def test_step_off_by_two_percent_is_a_gap() -> None:
    text = _make_text().replace("0.020000,", "0.020020,")
    assert len(parse_recording(text).gaps) == 2
    assert parse_recording(_make_text().replace("0.020000,", "0.020005,")).gaps == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("\n  \n", "empty"),
        (_make_text()[:-4], "truncated"),
        ("\n".join(_make_text().splitlines()[:6]) + "\n", "truncated"),
        ("\n".join(_make_text().splitlines()[:12]) + "\n", "truncated"),
        (_make_text() + "0.040000,1.0\n", "truncated"),
        (_make_text().replace("current_A", "amps"), "no column current_A"),
        (_remove_header(_make_text(), "# sample_rate_hz"), "no header sample_rate_hz"),
        (_remove_header(_make_text(), "# pitch"), "no header pitch_m_per_rev"),
        (_make_text(format="other-1"), "format 'other-1'"),
        (_make_text(voltage_sampling="sometimes"), "voltage_sampling"),
        (_make_text(sample_rate_hz="fast"), "sample_rate_hz"),
        (_make_text(pitch_m_per_rev="-1"), "pitch_m_per_rev"),
        (_make_text(rapid_speed_m_per_s="nan"), "rapid_speed_m_per_s"),
        (
            _make_text(pitch_m_per_rev="20"),
            "outside the 1e-05 to 0.8 of machines: correct it .is 20 in mm. then write 0.02",
        ),
        (_make_text(rapid_speed_m_per_s="500"), "is 500 in mm. then write 0.5"),
        (_make_text(sample_rate_hz="1e-301"), "outside the 1 to 1e.06"),
        (_make_text(sample_rate_hz="9" * 5000), "sample_rate_hz = '9999"),
        (_make_text().replace(",2.50000,", "," + "9" * 5000 + ","), "non-finite value '9999"),
        (_make_text().replace(",2.50000,", "," + "x" * 5000 + ","), "'xxxxx"),
        (_make_text() + "0," * 50_000 + "0\n", "has 100001 characters, which no valid row has"),
        (_make_text().replace("time_s,", "time_s," + "x," * 50_000), "which no valid row has"),
        (
            _make_text(voltage_begin_s="0", voltage_period_s="0.005", voltage_samples_V="0 " * 9_000_000),
            "too many voltage samples for a recording",
        ),
        (_make_text() + "1e300,1,1,1,1,1\n", "a gap of 1e.300 s is too long for one run"),
        (_make_text().replace(",2.50000,", ",2.5x,"), "2.5x"),
        (_make_text().replace(",2.50000,", ",nan,"), "non-finite"),
        (_make_text().replace(",2.50000,", ",inf,"), "non-finite"),
        (_make_text().replace("0.020000,", "0.019000,"), "time does not rise"),
        (_make_text(sample_rate_hz="2000"), "correct the header"),
    ],
    ids=lambda value: value if len(value) < 40 else "text",
)
def test_each_fault_is_reported_in_one_sentence(text: str, words: str) -> None:
    with pytest.raises(RecordingError, match=words) as caught:
        parse_recording(text, "r.csv")
    message = str(caught.value)
    assert message.startswith("r.csv")
    assert "\n" not in message
    assert len(message) < 200


def test_binary_or_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        read_recording(tmp_path / "absent.csv")
    binary = tmp_path / "b.csv"
    binary.write_bytes(b"\xff\xfe\x00\x80" * 40)
    with pytest.raises(RecordingError, match="not a text file"):
        read_recording(binary)


SLOW = {"voltage_begin_s": "0.0017", "voltage_period_s": "0.005", "voltage_samples_V": "1.5 nan -2"}


def test_slow_sensor_samples_in_headers_use_the_rows_time_axis() -> None:
    slow = parse_recording(_make_text(40, **SLOW)).slow_voltage
    assert slow is not None
    assert (slow.begin_s, slow.period_s, slow.error_s) == (0.0017, 0.005, 0.0)
    np.testing.assert_array_equal(slow.voltage_v, [1.5, np.nan, -2.0])
    first, second = _make_text(40, **SLOW).split("\n0.000000,", 1)
    cut = parse_recording(first + "\n" + second.split("\n", 1)[1]).slow_voltage
    assert cut is not None
    assert cut.begin_s == pytest.approx(0.0007)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("voltage_samples_V", "1.5 two"),
        ("voltage_samples_V", "nan nan"),
        ("voltage_samples_V", "1.5 inf"),
        ("voltage_period_s", "0"),
        ("voltage_period_s", ""),
        ("voltage_begin_s", "soon"),
        ("voltage_error_s", "nan"),
    ],
)
def test_damaged_slow_sensor_samples_are_refused(key: str, value: str) -> None:
    with pytest.raises(RecordingError):
        parse_recording(_make_text(40, **(SLOW | {key: value})))


def test_oversized_file_is_refused_before_parsing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_text, "MAX_BYTES", 1 << 20)
    monkeypatch.setattr(csv_text, "MAX_ROWS", 1000)
    with pytest.raises(RecordingError, match="larger than 1 MiB or 1000 rows: cut it into parts"):
        read_recording(Path("/dev/zero"))
    many = tmp_path / "many.csv"
    for end in ("\n", "\v", "\u2028"):
        many.write_text(end * 1001)
        with pytest.raises(RecordingError, match="larger than"):
            read_recording(many)


def _make_without_voltage(**headers: str) -> str:
    values = np.linspace(0.0, 20.0, 40, endpoint=False)
    text = bench.format_table(
        0.001, dict.fromkeys((name for name in COLUMNS if name != "voltage_V"), values), **headers
    )
    return _remove_header(text, "# voltage_sampling")


def test_recording_without_voltage_has_torque_constant() -> None:
    recording = parse_recording(_make_without_voltage(torque_constant_nm_per_a="0.3"))
    assert recording.voltage_v is None
    assert recording.torque_constant_nm_per_a == 0.3
    assert recording.current_a[2] == 1.0
    assert recording.demand_mm[2] == 1000.0
    assert parse_recording(_make_without_voltage()).torque_constant_nm_per_a is None
    with pytest.raises(RecordingError, match="no header voltage_sampling"):
        parse_recording(_remove_header(_make_text(), "# voltage_sampling"))


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        ({"torque_constant_nm_per_a": "0"}, "torque_constant_nm_per_a"),
        ({"torque_constant_nm_per_a": "3000"}, "outside the 0.001 to 100 of machines: correct it$"),
        ({"speed_source": "guess"}, "sensor or difference or filtered"),
        ({"voltage_source": "mains"}, "terminals or command"),
    ],
)
def test_invalid_signal_header_is_refused(headers: dict[str, str], words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        parse_recording(_make_without_voltage(**headers))


def test_only_table_sensors_may_lack_samples() -> None:
    columns: dict[str, bench.Array] = dict.fromkeys(COLUMNS, np.linspace(0.0, 29.0, 30))
    lacking = np.where(np.arange(30) == 5, np.nan, 1.0)
    read = parse_recording(bench.format_table(0.001, columns | {"table_mm": lacking, "table_m_s2": -lacking}))
    assert read.table_mm is not None
    assert read.table_m_s2 is not None
    assert np.flatnonzero(np.isnan(read.table_mm)).tolist() == [5]
    assert read.table_m_s2[6] == -1.0
    assert parse_recording(_make_text()).table_mm is None
    with pytest.raises(RecordingError, match="line 13 has the non-finite value 'nan'"):
        parse_recording(bench.format_table(0.001, columns | {"current_A": lacking}))
    with pytest.raises(RecordingError, match="line 13 has the non-finite value 'inf'"):
        parse_recording(bench.format_table(0.001, columns | {"table_mm": np.where(np.isnan(lacking), np.inf, 1.0)}))


def test_duplicates_are_refused_and_empty_cells_accepted() -> None:
    text = _make_text()
    with pytest.raises(RecordingError, match=r"header 'axis' = 'X' and again, in line \d+, 'Y': remove the wrong one"):
        parse_recording(text.replace("# axis: X\n", "# axis: X\n# axis: Y\n"))
    with pytest.raises(RecordingError, match=r"'current_A' above #3 and #4 \(line \d+\)"):
        parse_recording(text.replace("current_A,speed", "current_A,current_A,speed"))
    saved = "".join(line + "," * 5 * line.startswith("#") + "\n" for line in text.splitlines())
    assert parse_recording(saved).headers == parse_recording(text).headers


def test_other_separators_are_reported_with_the_columns() -> None:
    with pytest.raises(RecordingError, match=r"no column time_s, .*; it has 'time_s;voltage_V;.*--columns"):
        parse_recording(_make_text().replace(",", ";"))


def _make_rotary(text: str) -> str:
    text = text.replace("# pitch_m_per_rev: 0.02", "# pitch_deg_per_rev: 12\n# radius_m: 0.1")
    text = text.replace("# rapid_speed_m_per_s: 0.5", "# rapid_speed_deg_per_s: 300")
    return text.replace("position_m", "position_deg").replace("demand_m", "demand_deg")


def test_recording_of_a_rotary_axis_is_read_in_degrees() -> None:
    recording = parse_recording(_make_rotary(_make_text()))
    mm_per_deg = math.radians(100.0)
    assert recording.pitch_mm == pytest.approx(12.0 * mm_per_deg)
    assert recording.rapid_speed_rad_s == pytest.approx(300.0 / 12.0 * 2 * math.pi)
    assert recording.position_mm[2] == pytest.approx(1.0 * mm_per_deg)
    assert recording.demand_mm[2] == pytest.approx(1.0 * mm_per_deg)


def test_direct_drive_of_a_large_table_is_read() -> None:
    text = _make_rotary(_make_text()).replace("pitch_deg_per_rev: 12", "pitch_deg_per_rev: 360")
    assert parse_recording(text.replace("radius_m: 0.1", "radius_m: 0.8")).pitch_mm == pytest.approx(1600 * math.pi)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("# radius_m: 0.1\n", "", "has no header radius_m: give the radius at which its angles count as path error"),
        ("radius_m: 0.1", "radius_m: 100", "radius_m = 100, outside the 0.01 to 10"),
        ("pitch_deg_per_rev: 12", "pitch_deg_per_rev: 720", "pitch_deg_per_rev = 720, outside the 0.001 to 360"),
        (
            "# axis",
            "# pitch_m_per_rev: 0.02\n# axis",
            "has pitch_m_per_rev and pitch_deg_per_rev: keep the one for its axis",
        ),
        ("demand_deg", "demand_m", "has no column demand_deg"),
        (
            "# pitch_deg_per_rev: 12",
            "# pitch_m_per_rev: 0.02",
            "has position_deg and demand_deg, but no header pitch_deg_per_rev",
        ),
    ],
)
def test_missing_header_of_rotary_axis_is_named(old: str, new: str, words: str) -> None:
    with pytest.raises(RecordingError) as caught:
        parse_recording(_make_rotary(_make_text()).replace(old, new))
    assert words in str(caught.value)
