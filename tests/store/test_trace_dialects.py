"""A recording in any text dialect is read back equal or refused, never as other numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from fdhil.errors import RecordingError
from fdhil.store.column_map import ColumnMap, apply_column_map
from fdhil.store.recording_table import RecordingTable
from fdhil.store.trace_text import parse_trace
from tests.store.trace_dialects import (
    SIGNALS,
    Dialect,
    compute_written_values,
    count_kept_rows,
    make_column_map,
    make_signals,
    write_trace,
)

HABITS: dict[str, list[Any]] = {
    "separator": ["\t", ";", ",", "|", " ", "  ", ", ", "; "],
    "quotes": ["", "names", "all", "needed"],
    "decimal": [".", ","],
    "thousands": ["", ".", ",", "'", " ", "\u00a0"],
    "names": ["plain", "blanks", "unit", "comma"],
    "head": ["", "remark", "list", "keys", "sep", "group"],
    "units": [False, True],
    "comment": ["", "# ", "#", "% "],
    "footer": ["", "remark", "statistics", "EOF", "cut"],
    "end": ["\n", "\r\n", "\r", "\r\r\n"],
    "encoding": ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"],
    "time": ["ms", "s", "us", "clock", "date", "us date", "none"],
    "minus": ["-", "\u2212"],
    "form": [".4f", ".1f", ".3f", ".3e", ".9g", ".0f"],
    "trailing": [False, True],
    "extra": ["", "text", "index"],
    "lost": ["", "empty", "NaN", "---"],
    "begins_s": [0.0, -0.02],
    "repeated": [False, True],
}
# what must be read, not refused: one habit changed, and what is common together
READ = [
    Dialect(),
    *(
        replace(Dialect(), **{habit: value})
        for habit, values in HABITS.items()
        for value in values
        if (habit, value) not in {("separator", "  "), ("thousands", ".")}
    ),
    Dialect(separator=";", decimal=",", thousands="."),
    Dialect(separator=",", decimal=",", quotes="all"),
    Dialect(separator=",", decimal=",", quotes="needed", thousands="."),
    Dialect(separator="\t", decimal=",", names="blanks", footer="EOF"),
    Dialect(separator=",", decimal=".", quotes="all", thousands=","),
    Dialect(separator=",", names="comma", quotes="names"),
    Dialect(separator="  ", comment="# ", form=".3e"),
    Dialect(separator=";", decimal=",", form=".3e", head="sep", units=True),
    Dialect(separator="\t", time="none", trailing=True),
    Dialect(separator=";", decimal=",", time="us date", extra="text", lost="empty", footer="statistics"),
]


def _read_trace(dialect: Dialect) -> RecordingTable:
    reported = ColumnMap.model_validate(make_column_map(dialect))
    return apply_column_map(
        parse_trace(write_trace(dialect, make_signals()), reported.text, "trace"), reported, "trace"
    )


def _assert_equal(read: RecordingTable, dialect: Dialect) -> None:
    written, kept = compute_written_values(dialect, make_signals()), count_kept_rows(dialect)
    of = ("voltage_V", "current_A", "speed_rad_per_s", "position_m", "demand_m")
    for signal, name in zip(of, SIGNALS, strict=True):
        np.testing.assert_allclose(read.columns[signal], written[name][kept], rtol=1e-12, atol=1e-12, err_msg=signal)
    np.testing.assert_allclose(read.columns["time_s"], np.array(kept) * 1e-3, atol=1e-9)


@pytest.mark.parametrize("dialect", READ, ids=repr)
def test_common_dialect_is_read(dialect: Dialect) -> None:
    _assert_equal(_read_trace(dialect), dialect)


@pytest.mark.usefixtures("long_computation")
@given(st.fixed_dictionaries({}, optional={habit: st.sampled_from(values) for habit, values in HABITS.items()}))
@example({"separator": ",", "decimal": ",", "time": "none"})
@example({"separator": " ", "thousands": " "})
@example({"separator": ",", "names": "comma"})
@settings(max_examples=150)
def test_any_dialect_is_read_equal_or_refused(habits: dict[str, Any]) -> None:
    dialect = Dialect(**habits)
    assume(dialect.thousands != dialect.decimal)
    assume(dialect.encoding != "cp1252" or dialect.minus == "-")
    try:
        read = _read_trace(dialect)
    except RecordingError:
        return
    _assert_equal(read, dialect)
