"""The fault matrix keeps its tests: no row loses its last one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import goals
from tests.fault_matrix import ROWS, TESTS, TOLD_OTHERWISE, UNTESTED, marked
from tests.fault_table import blank, everything_survived, page, survived, to_zero

PAGE = TESTS.parent / "docs" / "studies" / "faults.md"


def test_each_row_is_there_once() -> None:
    counts = {letter: sum(row[0] == letter for row in ROWS) for letter in "ABCDEFG"}
    assert counts == {"A": 29, "B": 12, "C": 8, "D": 6, "E": 19, "F": 21, "G": 14}


def test_no_row_loses_its_last_test() -> None:
    assert marked().keys() <= ROWS.keys()
    without = ROWS.keys() - marked().keys()
    assert without == UNTESTED.keys(), "a row lost its last test, or has one now: UNTESTED only shrinks"


def test_each_row_is_told_by_the_name_of_its_class() -> None:
    """A file that proves a row names its class, unless the matrix states another report."""
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


def test_a_row_survives_only_where_it_was_tested_and_nothing_of_it_failed() -> None:
    assert survived(blank()) == "not tested"
    assert survived(blank() | {"real_passed": 1}) == "on SocketCAN only"
    assert survived(blank() | {"passed": 2, "real_passed": 1}) == "yes"
    for failed in ("failed", "real_failed"):
        assert survived(blank() | {"passed": 2, failed: ["a test"]}) == "**no**"
    every = {row: blank() | {"passed": 1, "real_passed": int(row[0] == "A")} for row in ROWS}
    assert everything_survived(every)
    assert not everything_survived(every | {"G1": blank()})
    assert not everything_survived({row: told | {"real_passed": 0} for row, told in every.items()})


@pytest.mark.parametrize(
    ("own", "studied", "told"),
    [
        ([], None, ""),
        ([20], None, "20"),
        ([20, 20], None, "20"),
        ([20, 23, 31], None, "23, at worst 31 of 3"),
        ([20], {"median": 21.0, "worst": 29, "trials": 1200}, "21, at worst 29 of 1,200"),
    ],
)
def test_the_column_of_zero_tells_median_and_worst(own: list[int], studied: dict[str, float] | None, told: str) -> None:
    assert to_zero(own, studied) == told


def test_a_goal_is_met_where_all_that_was_measured_says_so(tmp_path: Path) -> None:
    run = {"command": "python -m studies.kills", "date": "2026-11-23", "commit": "abc"}
    for name, met in (("kills", True), ("guard_invariants", False)):
        figures = {"goals": {"R3": {"met": met, "figure": f"by {name}"}, "R5": {"met": True, "figure": "none"}}}
        (tmp_path / f"{name}.json").write_text(json.dumps({"study": name, "run": run, "figures": figures}))
    found = goals.of_studies(tmp_path)
    lines = {line.split(" | ")[0].strip("| "): line for line in goals.lines(found)}
    assert "by guard_invariants; by kills | **no** | `python -m studies.kills` | 2026-11-23 (abc) |" in lines["R3"]
    assert "| yes |" in lines["R5"]
    assert "| not measured |  |  |  |" in lines["R4"]
    assert goals.summary(found) == "1 of 20 goals are met, 1 not, 18 not measured."
    (tmp_path / "kills.json").write_text(json.dumps({"figures": {"goals": {"R21": {"met": True, "figure": ""}}}}))
    with pytest.raises(ValueError, match="a goal R21 that there is not"):
        goals.of_studies(tmp_path)
