"""File heads of oscilloscopes, drives and programs: which names a column map can use."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fdhil.errors import RecordingError
from fdhil.store.recording_table import RecordingTable
from fdhil.store.trace_text import TraceText, parse_trace

N = 40
TIME = np.arange(N) * 1e-3
U = np.round(10 * np.sin(np.arange(N) / 7), 4)
I = np.round(2 * np.cos(np.arange(N) / 5), 4)  # noqa: E741 - the current
Row = Callable[[int], str]


def _make_comma_trace(text: str) -> str:
    return text.replace(".", ",")


def _make_labels(k: int) -> str:
    labels = ["Record Length,40,Points", "Sample Interval,0.001,s", "Trigger Point,100,Samples", ",,", "Offset,0,s"]
    return labels[k] if k < len(labels) else ",,"


LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nDate\t2025/03/05\nTime\t10:22:03,1234567\n"
    "***End_of_Header***\t\t\t\nChannels\t2\t\t\nSamples\t40\t40\t\nX0\t0,0E+0\t0,0E+0\t\nDelta_X\t0,001\t0,001\t\n"
    "***End_of_Header***\t\t\t\nX_Value\tSpannung\tStrom\tComment\n"
)
YOKOGAWA = (
    '"Model Name","DL850"\n"TraceName"," CH1"," CH2"\n"BlockSize",40,40\n"SampleRate",1.0E+03,1.0E+03\n'
    '"HResolution",1.0E-03,1.0E-03\n"HOffset",-1.0E-02,-1.0E-02\n"Date"," 2025/03/05"," 2025/03/05"\n\n'
)
# instrument -> its head, its rows, and what stands above time, voltage and current
HEADS: dict[str, tuple[str, Row, tuple[str, str, str]]] = {
    "Tektronix MSO": (
        "Model,MSO4034\n\nPoint Format,Y,\nProbe Attenuation,10,1\nVertical Units,V,A\nLabel,,\nTIME,CH1,CH2\n",
        lambda k: f"{TIME[k]:.6e},{U[k]},{I[k]}",
        ("TIME", "CH1", "CH2"),
    ),
    "Tektronix TDS": ("", lambda k: f"{_make_labels(k)},{TIME[k]:.6f},{U[k]},{I[k]},", ("#4", "#5", "#6")),
    "Keysight": (
        "x-axis,1,2\nsecond,Volt,Ampere\n",
        lambda k: f"{TIME[k]:+.8E},{U[k]:+.5E},{I[k]:+.5E}",
        ("x-axis", "1", "2"),
    ),
    "Siglent": (
        "Record Length,Analog:40\nVertical Scale,CH1:1.0,CH2:1.0\nSource,CH1,CH2\nSecond,Volt,Volt\n",
        lambda k: f"{TIME[k]:.12f},{U[k]:.5f},{I[k]:.5f}",
        ("Second", "CH1", "CH2"),
    ),
    "PicoScope": (
        "Zeit;Kanal A;Kanal B\n(s);(V);(A)\n\n",
        lambda k: _make_comma_trace(f"{TIME[k]:.8f};{U[k]:.8f};{I[k]:.8f}"),
        ("Zeit", "Kanal A", "Kanal B"),
    ),
    "Rohde & Schwarz": (
        "in s,C1 in V,C2 in A\n",
        lambda k: f"{TIME[k]:.6E},{U[k]:.5E},{I[k]:.5E}",
        ("in s", "C1 in V", "C2 in A"),
    ),
    "LabVIEW": (
        LABVIEW,
        lambda k: _make_comma_trace(f"{TIME[k]:.6f}\t{U[k]:.6f}\t{I[k]:.6f}"),
        ("X_Value", "Spannung", "Strom"),
    ),
    "Yokogawa": (YOKOGAWA, lambda k: f",{U[k]:.5E},{I[k]:.5E},{TIME[k]}", ("#4", "#2", "#3")),
    "halsampler": ("", lambda k: f"{TIME[k]:.6f} {U[k]:.6f} {I[k]:.6f} ", ("#1", "#2", "#3")),
    "pandas": (",t,u,i\n", lambda k: f"{k},{TIME[k]:.4f},{U[k]},{I[k]}", ("t", "u", "i")),
    "catman": (
        "HBM_CATMAN\t\t\r\nMessrate\t1000 Hz\t\r\nZeit  1 - Standard\tSpannung\tStrom\r\ns\tV\tA\r\n",
        lambda k: _make_comma_trace(f"{TIME[k]:.6f}\t{U[k]:.5f}\t{I[k]:.5f}"),
        ("Zeit 1 - Standard", "Spannung", "Strom"),
    ),
    "two lines in a name": (
        'Time,"Voltage\n[V]",Current\n',
        lambda k: f"{TIME[k]:.4f},{U[k]},{I[k]}",
        ("Time", "Voltage [V]", "Current"),
    ),
    "a quote that never ends": (
        '"Remark, no end\nTime,U,I\n',
        lambda k: f"{TIME[k]:.4f},{U[k]},{I[k]}",
        ("Time", "U", "I"),
    ),
    "rows as one quoted cell each": (
        "Time;U;I\n",
        lambda k: _make_comma_trace(f'"{TIME[k]:.4f};{U[k]};{I[k]}"'),
        ("Time", "U", "I"),
    ),
    "a table of Markdown": (
        "| Time | U | I |\n|------|---|---|\n",
        lambda k: f"| {TIME[k]:.4f} | {U[k]} | {I[k]} |",
        ("Time", "U", "I"),
    ),
    "names with wide blanks": (
        "Time s   Axis voltage   Axis current\n",
        lambda k: f"{TIME[k]:6.3f}   {U[k]:12.4f}   {I[k]:12.4f}",
        ("Time s", "Axis voltage", "Axis current"),
    ),
}


def _parse(head: str, row: Row) -> RecordingTable:
    return parse_trace((head + "".join(f"{row(k)}\n" for k in range(N))).encode(), TraceText(), "trace")


@pytest.mark.parametrize("instrument", HEADS)
def test_instrument_headings_name_the_columns(instrument: str) -> None:
    head, row, names = HEADS[instrument]
    read = _parse(head, row)
    for name, values in zip(names, (TIME, U, I), strict=True):
        assert name not in read.doubts
        np.testing.assert_allclose(read.columns[name], values, atol=1e-4)


@pytest.mark.parametrize(
    ("head", "name", "words"),
    [
        ("Time;Axis X;;Axis Y;\n;U;I;U;I\n", "U", "names #2 and #4"),
        ("X;CH1;CH2;Start;Increment;More\n", "CH1", "is one of the 6 cells of line 1, the rows have 5"),
        ("Time, s;Voltage\n", "Voltage", "is one of the 2 cells of line 1, the rows have 5"),
    ],
)
def test_name_without_unique_column_is_doubtful(head: str, name: str, words: str) -> None:
    read = _parse(head, lambda k: f"{k};{U[k]};{I[k]};{U[k]};{I[k]}")
    assert words in read.doubts[name]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (lambda k: f"{k},{_make_comma_trace(f'{U[k]:.2f}')},{_make_comma_trace(f'{I[k]:.2f}')}", "decimal commas"),
        (lambda k: f"{k};{k + 1}.125;{k + 2}.250", "may be decimal or separate thousands"),
        (lambda k: f"{k};{U[k]};{I[k]}" if k != 9 else "9;1.5", "2 cells in line 10, the other rows have 3"),
        (lambda k: f"{k};{U[k]};{I[k]}" if k != 9 else "9;1;5;2", "4 cells in line 10, the other rows have 3"),
        (lambda k: f"{k},{U[k]}," if k != 9 else "9,1,051.5,", "4 cells in line 10, the other rows have 3"),
        (lambda k: f"{k},{U[k]},OK," if k != 9 else "9,1,051.5,OK,", "5 cells in line 10, the other rows have 4"),
        (lambda k: f"{k},{U[k]},," if k != 9 else "9,1,051.5,", "3 cells in line 10, the other rows have 2"),
        (
            lambda k: f"{k} {U[k]} {I[k]}" + ("\noverrun" if k == 9 else ""),
            "line 11 is not a row of numbers: 'overrun'",
        ),
        (lambda k: f"{k if k < 20 else 'late'};{U[k]};{I[k]}", "line 21 is .*, and 20 rows of numbers follow"),
        (lambda k: f"{k} ms;{U[k]} V;{I[k]} A", "no rows of numbers"),
    ],
)
def test_ambiguous_rows_are_refused(row: Row, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        _parse("", row)


def test_text_among_numbers_makes_its_column_doubtful() -> None:
    read = _parse("Time;U;I\n", lambda k: f"{k};{U[k] if k != 9 else '12.x'};{I[k]}")
    assert "has '12.x' in line 11" in read.doubts["U"] == read.doubts["#2"]
    assert "I" not in read.doubts


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (lambda k: f"{k};{U[k]};{2 * k};{I[k]}", "is a separate time of each channel"),
        (lambda k: f"{k};{U[k]};{k};{I[k]}", "names #1 and #3"),
    ],
)
def test_times_of_each_channel_must_agree(row: Row, words: str) -> None:
    read = _parse("Name;U;Name;I\n", row)
    assert words in read.doubts.get("#1", read.doubts["Name"])
    assert ("#1" in read.doubts) == ("separate" in words)


def test_text_in_first_row_is_not_a_head() -> None:
    read = _parse("Time;U;I\n", lambda k: f"{k};{U[k] if k > 1 else 'start'};{I[k]}")
    assert read.columns["I"].size == N
    assert "has 'start' in line 2" in read.doubts["U"]


def test_name_may_begin_like_a_comment() -> None:
    read = _parse("% duty;# Time;U\n", lambda k: f"{I[k]};{TIME[k]:.3f};{U[k]}")
    assert {"% duty", "duty", "# Time", "U"} <= read.columns.keys()


@pytest.mark.parametrize(("cut", "kept"), [(0, N), (1, N - 1), (3, N - 1), (9, N - 1)])
def test_incomplete_last_row_is_left_out(cut: int, kept: int) -> None:
    text = "Time;U;I\n" + "\n".join(f"{TIME[k]:.4f};{U[k]:.4f};{I[k]:.4f}" for k in range(N))
    read = parse_trace(text[: len(text) - cut].encode(), TraceText(), "trace")
    assert read.columns["I"].size == kept
    np.testing.assert_allclose(read.columns["I"], I[:kept])


def test_empty_line_after_each_row_is_not_an_interruption() -> None:
    assert _parse("Time;U;I\n\n", lambda k: f"{k};{U[k]};{I[k]}\n").interruption == ""
    assert "line 11" in _parse("", lambda k: f"{k};{U[k]};{I[k]}" + ("\n" if k == 9 else "")).interruption


@pytest.mark.parametrize(
    ("begins", "words"),
    [
        (b"MDF     3.30    ", "version 3 or older: save it as MDF 4"),
        (b"MDF     4.10    ", "an MDF 4 file: name it .mf4"),
        (b"PK\x03\x04", "Excel workbook: save the sheet as CSV"),
        (b"PAR1", "a Parquet file: name it .parquet"),
    ],
)
def test_binary_file_is_refused_with_its_kind(begins: bytes, words: str) -> None:
    with pytest.raises(RecordingError, match=f"is not a text but .*{words}"):
        parse_trace(begins + bytes(range(256)), TraceText(), "trace")
