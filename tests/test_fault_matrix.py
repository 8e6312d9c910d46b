"""The fault matrix keeps its tests: no row loses its last one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests import goals
from tests.fault_matrix import ROWS, TESTS, TOLD_OTHERWISE, UNTESTED, mark_rows
from tests.fault_table import create_blank, format_page, format_time_to_zero, has_survived, has_survived_all

PAGE = TESTS.parent / "docs" / "studies" / "faults.md"


def test_each_row_exists_once() -> None:
    counts = {letter: sum(row[0] == letter for row in ROWS) for letter in "ABCDEFG"}
    assert counts == {"A": 29, "B": 12, "C": 8, "D": 6, "E": 19, "F": 21, "G": 14}


def test_every_row_has_a_test() -> None:
    assert mark_rows().keys() <= ROWS.keys()
    without = ROWS.keys() - mark_rows().keys()
    assert without == UNTESTED.keys(), "a row lost its last test, or has one now: UNTESTED only shrinks"


def test_each_row_is_named_by_its_class() -> None:
    """A file that proves a row names its class, unless the matrix states another report."""
    texts = {path: path.read_text("utf-8") for paths in mark_rows().values() for path in paths}
    silent = [
        f"{row} {name}"
        for row, paths in mark_rows().items()
        for name in ROWS[row].classes
        if row not in TOLD_OTHERWISE and not any(name in texts[path] for path in paths)
    ]
    assert silent == []


def test_page_matches_figures() -> None:
    figures = json.loads(PAGE.with_suffix(".json").read_text("utf-8"))
    assert list(figures["rows"]) == list(ROWS)
    assert format_page(figures) == PAGE.read_text("utf-8")
    lost = [row for row, told in figures["rows"].items() if not any(told.values()) and row not in UNTESTED]
    assert lost == [], "run make faults"


def test_row_survives_only_if_tested_without_failure() -> None:
    assert has_survived(create_blank()) == "not tested"
    assert has_survived(create_blank() | {"real_passed": 1}) == "on SocketCAN only"
    assert has_survived(create_blank() | {"passed": 2, "real_passed": 1}) == "yes"
    for failed in ("failed", "real_failed"):
        assert has_survived(create_blank() | {"passed": 2, failed: ["a test"]}) == "**no**"
    every = {row: create_blank() | {"passed": 1, "real_passed": int(row[0] == "A")} for row in ROWS}
    assert has_survived_all(every)
    assert not has_survived_all(every | {"G1": create_blank()})
    assert not has_survived_all({row: told | {"real_passed": 0} for row, told in every.items()})


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
def test_time_to_zero_column_has_median_and_worst(own: list[int], studied: dict[str, float] | None, told: str) -> None:
    assert format_time_to_zero(own, studied) == told


def test_goal_is_met_if_all_measurements_agree(tmp_path: Path) -> None:
    run = {"command": "python -m studies.kills", "date": "2026-11-23", "commit": "abc"}
    for name, met in (("kills", True), ("guard_invariants", False)):
        figures = {"goals": {"R3": {"met": met, "figure": f"by {name}"}, "R5": {"met": True, "figure": "none"}}}
        (tmp_path / f"{name}.json").write_text(json.dumps({"study": name, "run": run, "figures": figures}))
    found = goals.read_study_goals(tmp_path)
    lines = {line.split(" | ")[0].strip("| "): line for line in goals.format_goal_lines(found)}
    assert "by guard_invariants; by kills | **no** | `python -m studies.kills` | 2026-11-23 (abc) |" in lines["R3"]
    assert "| yes |" in lines["R5"]
    assert "| not measured |  |  |  |" in lines["R4"]
    assert goals.summarise_goals(found) == "1 of 20 goals are met, 1 not, 18 not measured."
    (tmp_path / "kills.json").write_text(json.dumps({"figures": {"goals": {"R21": {"met": True, "figure": ""}}}}))
    with pytest.raises(ValueError, match="a goal R21 that there is not"):
        goals.read_study_goals(tmp_path)
