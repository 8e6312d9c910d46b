"""The fault matrix keeps its tests: a row that had one never loses its last."""

from __future__ import annotations

import json

from tests.fault_matrix import ROWS, TESTS, TOLD_OTHERWISE, UNTESTED, marked
from tests.fault_table import page

PAGE = TESTS.parent / "docs" / "studies" / "faults.md"


def test_each_row_is_there_once() -> None:
    counts = {letter: sum(row[0] == letter for row in ROWS) for letter in "ABCDEFG"}
    assert counts == {"A": 29, "B": 12, "C": 8, "D": 6, "E": 19, "F": 21, "G": 14}


def test_no_row_loses_its_last_test() -> None:
    assert marked().keys() <= ROWS.keys()
    without = ROWS.keys() - marked().keys()
    assert without == UNTESTED.keys(), "a row lost its last test, or has one now: UNTESTED only shrinks"


def test_each_row_is_told_by_the_name_of_its_class() -> None:
    """A file that proves a row names its class, unless the product tells it otherwise and the matrix says how."""
    texts = {path: path.read_text("utf-8") for paths in marked().values() for path in paths}
    silent = [
        f"{row} {name}"
        for row, paths in marked().items()
        for name in ROWS[row].classes
        if row not in TOLD_OTHERWISE and not any(name in texts[path] for path in paths)
    ]
    assert silent == []


def test_the_page_is_what_its_figures_say() -> None:
    figures = json.loads(PAGE.with_suffix(".json").read_text("utf-8"))
    assert list(figures["rows"]) == list(ROWS)
    assert page(figures) == PAGE.read_text("utf-8")
    lost = [row for row, told in figures["rows"].items() if not any(told.values()) and row not in UNTESTED]
    assert lost == [], "run make faults"
