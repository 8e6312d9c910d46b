"""Files of oscilloscopes and drives become recordings by a column map."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fdhil.errors import ConfigError, RecordingError
from fdhil.store.column_map import read_column_map
from fdhil.store.recording_file import read_recording

N, PITCH_M = 400, 0.01
TIME = np.arange(N) * 1e-3
SPEED = 100.0 * np.sin(np.pi * TIME / TIME[-1]) ** 2
POSITION = np.cumsum(SPEED) * 1e-3 * PITCH_M / (2 * math.pi)
CURRENT = 0.1 * SPEED + 1.25
HEADERS = '[headers]\naxis = "X"\npitch_m_per_rev = 0.01\nrapid_speed_m_per_s = 0.15\ntorque_constant_nm_per_a = 0.3\n'


def _make_comma_trace(value: float) -> str:
    return f"{value:.9g}".replace(".", ",")


def _make_twincat_trace(columns: dict[str, np.ndarray]) -> bytes:
    lines = ["Name\tScope Project", "File\tC:\\scope.csv", "Starttime of export\t128783093223690000", ""]
    lines.append("\t".join(f"Name\t{name}" for name in columns))
    lines.append("\t".join("SampleTime[ms]\t1" for _ in columns))
    lines.append("\t".join(f"SymbolName\tMAIN.{name}" for name in columns))
    lines.append("")
    for k in range(N):
        lines.append("\t".join(f"{k}\t{_make_comma_trace(v[k])}" for v in columns.values()))
    return "\r\n".join([*lines, "EOF", ""]).encode()


def _make_semicolon_trace(columns: dict[str, np.ndarray]) -> bytes:
    lines = [";".join(["Time", *columns]), ";".join(["ms", *("[]" for _ in columns)])]
    lines += [";".join([f"{k}", *(f"{v[k]:.9g}" for v in columns.values())]) for k in range(N)]
    return "\r\n".join([*lines, ""]).encode("utf-16")


def _make_quoted_trace(columns: dict[str, np.ndarray]) -> bytes:
    lines = ["Oszilloskop, Kanäle Achse X", ",".join(['"Zeit"', *(f'"{name}"' for name in columns)])]
    lines += [",".join([f"{k * 1e-3:.6f}", *(f"{v[k]:.9g}" for v in columns.values())]) for k in range(N)]
    return ("\n".join(lines) + "\n").encode("cp1252")


CASES: dict[str, tuple[Callable[[dict[str, np.ndarray]], bytes], str]] = {
    "twincat": (_make_twincat_trace, 'time_s = { name = "#1", unit = "ms" }'),
    "semicolon": (_make_semicolon_trace, 'time_s = { name = "Time", unit = "ms" }'),
    "quoted": (_make_quoted_trace, 'time_s = { name = "Zeit", unit = "s" }'),
}
MAP = """
[columns]
%s
current_A = { name = "Strom", unit = "mA" }
speed_rad_per_s = { name = "Drehzahl", unit = "rpm" }
position_m = { name = "Ist", unit = "mm" }
demand_m = [{ name = "Ist", unit = "mm" }, { name = "Schlepp", unit = "um" }]
"""


def _make_columns() -> dict[str, np.ndarray]:
    return {
        "Strom": CURRENT * 1e3,
        "Drehzahl": SPEED * 60 / (2 * math.pi),
        "Ist": POSITION * 1e3,
        "Schlepp": SPEED * 2.0,
    }


@pytest.mark.parametrize("case", CASES)
def test_vendor_text_file_becomes_a_recording(case: str, tmp_path: Path) -> None:
    write, time = CASES[case]
    trace, reported = tmp_path / "trace.csv", tmp_path / "map.toml"
    trace.write_bytes(write(_make_columns()))
    reported.write_text(HEADERS + MAP % time)
    read = read_recording(trace, read_column_map(reported))
    assert (read.axis, read.dt_s, read.voltage_v, read.torque_constant_nm_per_a) == ("X", 0.001, None, 0.3)
    np.testing.assert_allclose(read.current_a, CURRENT, rtol=1e-7)
    np.testing.assert_allclose(read.speed_rad_s, SPEED, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(read.demand_mm - read.position_mm, SPEED * 2e-3, atol=1e-6)


def test_missing_speed_is_difference_of_positions(tmp_path: Path) -> None:
    trace, reported = tmp_path / "trace.csv", tmp_path / "map.toml"
    trace.write_bytes(_make_semicolon_trace(_make_columns()))
    reported.write_text(
        HEADERS + MAP.replace('speed_rad_per_s = { name = "Drehzahl", unit = "rpm" }\n', "") % CASES["semicolon"][1]
    )
    read = read_recording(trace, read_column_map(reported))
    assert read.headers["speed_source"] == "difference"
    np.testing.assert_allclose(read.speed_rad_s[1:], SPEED[1:], rtol=1e-5, atol=1e-4)


def test_table_speed_needs_only_the_pitch(tmp_path: Path) -> None:
    trace, reported = tmp_path / "trace.csv", tmp_path / "map.toml"
    trace.write_bytes(_make_semicolon_trace(_make_columns() | {"Drehzahl": SPEED * PITCH_M / (2 * math.pi) * 60e3}))
    reported.write_text(HEADERS + MAP.replace('"rpm"', '"mm/min"') % CASES["semicolon"][1])
    np.testing.assert_allclose(
        read_recording(trace, read_column_map(reported)).speed_rad_s, SPEED, rtol=1e-7, atol=1e-9
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('unit = "mA"', 'unit = "furlong"', "columns.current_A.unit"),
        ('axis = "X"\n', "", "headers.axis"),
        ("position_m = ", "position_mm = ", "position_mm"),
        ("[columns]", "[columns", "is not valid TOML"),
        ('current_A = { name = "Strom", unit = "mA" }\n', "", "columns.current_A"),
    ],
)
def test_invalid_map_is_refused_with_its_key(old: str, new: str, words: str, tmp_path: Path) -> None:
    reported = tmp_path / "map.toml"
    reported.write_text((HEADERS + MAP % CASES["twincat"][1]).replace(old, new))
    with pytest.raises(ConfigError, match=words):
        read_column_map(reported)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"no numbers\nat all\n", "no rows of numbers"),
        (b"Zeit,Strom\n0,1\n1,2\n2,3\n3,4\n", "has no column 'Drehzahl'"),
        (
            b"Zeit,Strom,Drehzahl,Ist,Schlepp\n0,1,2,3,4\n1,1,2,3,4\n2,1,2,3,4\nend,of,it,,\n3,1,2,3,4\n",
            "not a row of numbers",
        ),
    ],
)
def test_trace_that_contradicts_the_map_is_refused_in_one_sentence(content: bytes, words: str, tmp_path: Path) -> None:
    trace, reported = tmp_path / "trace.csv", tmp_path / "map.toml"
    trace.write_bytes(content)
    reported.write_text(HEADERS + MAP % CASES["quoted"][1])
    with pytest.raises(RecordingError, match=words):
        read_recording(trace, read_column_map(reported))


@pytest.mark.parametrize(
    ("units", "name", "old", "new", "words"),
    [
        ("ms;A;rpm;mm;um", "Strom", "", "", "'Strom' in A, the column map has mA"),
        ("s;mA;rpm;mm;um", "Strom", "", "", "'Time' in s, the column map has ms"),
        ("ms;;rpm;mm;um", "Strom [A]", '"Strom"', '"Strom [A]"', r"'Strom \[A\]' in A, the column map has mA"),
        ("ms;;rpm;mm;um", "Strom / A", '"Strom"', '"Strom / A"', "'Strom / A' in A, the column map has mA"),
        ("ms;;rpm;mm;um", "C1 in A", '"Strom"', '"C1 in A"', "'C1 in A' in A, the column map has mA"),
        ("ms;;rpm;mm;um", "Strom, mA", '"Strom"', '"Strom, mA"', ""),
        ("ms;;rpm;mm;um", "Phase A", '"Strom"', '"Phase A"', ""),
        ("ms;A;rpm;mm;um", "Strom", 'unit = "mA"', 'unit = "mA", factor = 1', ""),
        ("[ms];(mA);U/min;mm;\u00b5m", "Strom", "", "", ""),
        ("V;V;V;V;V", "Strom", "", "", ""),
    ],
)
def test_unit_that_contradicts_the_file_is_refused(
    units: str, name: str, old: str, new: str, words: str, tmp_path: Path
) -> None:
    trace, reported = tmp_path / "trace.csv", tmp_path / "map.toml"
    text = (
        _make_semicolon_trace(_make_columns()).decode("utf-16").replace("ms;[];[];[];[]", units).replace("Strom", name)
    )
    trace.write_bytes(text.encode())
    reported.write_text((HEADERS + MAP % CASES["semicolon"][1]).replace(old, new))
    if not words:
        assert read_recording(trace, read_column_map(reported)).current_a.size == N
        return
    with pytest.raises(RecordingError, match=words):
        read_recording(trace, read_column_map(reported))


@pytest.mark.parametrize(
    ("time_ms", "words"),
    [
        (lambda k: N - k, "time does not rise at -0.001 s: sort"),
        (lambda k: k if k != 200 else 199, "time does not rise at 0.199 s"),
        (lambda k: 5, "time does not rise at 0 s: its resolution is too low; .* give sample_rate_hz"),
    ],
)
def test_times_that_do_not_rise_are_refused(time_ms: Callable[[int], int], words: str, tmp_path: Path) -> None:
    trace, reported = tmp_path / "trace.csv", tmp_path / "map.toml"
    head, rows = _make_semicolon_trace(_make_columns()).decode("utf-16").split("[]\r\n", 1)
    cells = [row.partition(";")[2] for row in rows.splitlines()]
    trace.write_text("\n".join([f"{head}[]", *(f"{time_ms(k)};{row}" for k, row in enumerate(cells)), ""]))
    reported.write_text(HEADERS + MAP % CASES["semicolon"][1])
    with pytest.raises(RecordingError, match=words):
        read_recording(trace, read_column_map(reported))
