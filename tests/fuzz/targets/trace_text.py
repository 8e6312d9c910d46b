"""Traces of other programs as text: columns of numbers, or a RecordingError with advice."""

from __future__ import annotations

from fdhil.errors import RecordingError
from fdhil.store.column_map import ColumnMap, apply_column_map
from fdhil.store.recording_table import make_recording
from fdhil.store.trace_text import parse_trace
from tests.fuzz.input_assessment import Target
from tests.store.trace_dialects import Dialect, make_column_map, make_signals, write_trace

WORDS = [
    b"sep=;", b'"', b'""', b"1.009,38", b"1,5E-03", b"\xe2\x88\x92", b"13:59:59.7", b"2025-03-05T10:22:03", b"NaN",
    b"EOF", b"\r\r\n", b"\xff\xfe", b"1e999", b"Voltage", b"\t", b"|", b"# ", b"65535", b"-32768",
]  # fmt: skip
DIALECTS = [
    Dialect(),
    Dialect(separator=",", decimal=",", quotes="all", head="remark", footer="statistics"),
    Dialect(separator="\t", decimal=",", thousands=".", head="list", units=True, footer="EOF"),
    Dialect(separator="  ", comment="# ", form=".3e", time="none"),
    Dialect(separator=";", time="us date", extra="text", lost="empty", head="sep"),
]


def taste(data: bytes) -> None:
    """Read the bytes by a map with all columns in the file, or only the names."""
    for dialect in (DIALECTS[0], DIALECTS[3]):
        reported = ColumnMap.model_validate(make_column_map(dialect))
        try:
            make_recording(apply_column_map(parse_trace(data, reported.text, "r"), reported, "r"), "r")
        except RecordingError as error:
            assert len(str(error)) < 2000


def target() -> Target:
    few = {name: values[:12] for name, values in make_signals().items()}
    seeds = [write_trace(dialect, few) for dialect in DIALECTS]
    return Target("trace_text", seeds, taste, WORDS, 2500)
