"""Pytest plugin behind ``make faults``: runs the tests marked ``fault`` or ``goal`` and reports the results row by row.

``--fault-table PATH`` prints the tables at the end and writes PATH (a page) with its figures next to it (.json);
``--on-socketcan`` adds results on a real SocketCAN interface to existing figures. A test reports its measurements by
``record_property``: ``sync_to_zero``, the SYNC count from the fault to the first frames with zero; ``goal``, a goal's
figure.

``python -m tests.fault_table`` collects the goals of the studies, runs nothing, and writes the page.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from tests import goals
from tests.fault_matrix import ROWS, TESTS, TOLD_OTHERWISE

PAGE = TESTS.parent / "docs" / "studies" / "faults.md"
LEAST_REAL = 25
Told = dict[str, Any]
HEAD = """# The fault matrix, row by row, and the goals

Written by `make faults`: each fault that may happen to the machine, the bus, the sensors, the disk, the operator or the
network, the class that tells it, and whether fdhil survived it, that is, whether every test of the row passed. A row
counts as tested only where a test sees the safe reaction. "SYNC to zero" counts on the frames of the bus, from the
fault to the first offset of zero on every axis: by the row's tests, or by the study of kills (`kills.json`) where it
has that row. A row without a figure freezes, refuses, or is none of a correction that runs.
"""
GOALS = """## The goals

What was measured last of each, by which command, on which day and commit. What was not measured has no figure.
"""


class FaultTable:
    """Outcomes of the tests of each row and goal."""

    def __init__(self, path: Path, real: bool) -> None:
        self.path, self.figures = path, path.with_suffix(".json")
        self._passed, self._failed = ("real_passed", "real_failed") if real else ("passed", "failed")
        if real:
            self.document: dict[str, Any] = json.loads(self.figures.read_text("utf-8"))
        else:
            self.document = {"run": read_provenance(), "rows": {row: create_blank() for row in ROWS}, "goals": {}}
        for reported in self.document["rows"].values():
            reported |= {self._passed: 0, self._failed: []}
        self._rows_of: dict[str, tuple[str, ...]] = {}
        self._goals_of: dict[str, tuple[str, ...]] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Record what each test proves."""
        for item in items:
            self._rows_of[item.nodeid] = count_proven_rows(item)
            self._goals_of[item.nodeid] = count_proven_goals(item)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a completed test, and one that failed in set-up or tear-down."""
        seen = dict(report.user_properties)
        for row in self._rows_of.get(report.nodeid, ()):
            reported = self.document["rows"][row]
            if report.failed:
                reported[self._failed].append(report.nodeid)
            elif report.passed and report.when == "call":
                reported[self._passed] += 1
                reported["sync_to_zero"] += [seen["sync_to_zero"]] if "sync_to_zero" in seen else []
        for goal in self._goals_of.get(report.nodeid, ()):
            if report.failed:
                self._record_outcome(goal, False, f"{report.nodeid} failed")
            elif report.passed and report.when == "call" and "goal" in seen:
                self._record_outcome(goal, True, str(seen["goal"]))

    def _record_outcome(self, goal: str, met: bool, figure: str) -> None:
        run = self.document["run"]
        entry = {"met": met, "figure": figure, "by": goals.SOURCE, "date": run["date"], "commit": run["commit"]}
        self.document["goals"].setdefault(goal, []).append(entry)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the tables and write the page."""
        gather_outcomes(self.document, self.path.parent)
        write_page(self.document, self.path)
        terminalreporter.section("fault matrix")
        for line in (*format_table(self.document), summarise_matrix(self.document["rows"])):
            terminalreporter.write_line(line)
        terminalreporter.section("goals")
        for line in (*goals.format_goal_lines(self.document["goals"]), goals.summarise_goals(self.document["goals"])):
            terminalreporter.write_line(line)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fault-table", type=Path, help="tell each row of the fault matrix and each goal in PATH")
    parser.addoption("--on-socketcan", action="store_true", help="add this run to what --fault-table wrote before")


def pytest_configure(config: pytest.Config) -> None:
    """Register the table where it was requested."""
    if path := config.getoption("--fault-table"):
        config.pluginmanager.register(FaultTable(path, config.getoption("--on-socketcan")), "fault-table-rows")


def count_proven_rows(item: pytest.Item) -> tuple[str, ...]:
    """Return the rows of a test; a parametrised case whose id begins with a row's proves that row alone."""
    rows = {row for mark in item.iter_markers("fault") for row in mark.args}
    if unknown := rows - ROWS.keys():
        raise pytest.UsageError(f"{item.nodeid} names {sorted(unknown)}, which the fault matrix does not have")
    case = item.name.partition("[")[2].rstrip("]").split(" ")[0].split("-")[0]
    return (case,) if case in rows else tuple(sorted(rows))


def count_proven_goals(item: pytest.Item) -> tuple[str, ...]:
    """Return the goals of a test."""
    proven = {goal for mark in item.iter_markers("goal") for goal in mark.args}
    if unknown := proven - goals.GOALS.keys():
        raise pytest.UsageError(f"{item.nodeid} names {sorted(unknown)}, which are no goals")
    return tuple(sorted(proven))


def create_blank() -> Told:
    """Return the entry of a row without any test."""
    return {"passed": 0, "failed": [], "real_passed": 0, "real_failed": [], "sync_to_zero": []}


def gather_outcomes(document: dict[str, Any], folder: Path) -> None:
    """Combine the measurements of the studies in ``folder``, and R1 of the rows, with the goals proved by tests."""
    run, proven = document["run"], document["goals"]
    own = {goal: [each for each in told if each["by"] == goals.SOURCE] for goal, told in proven.items() if goal != "R1"}
    figure, met = summarise_matrix(document["rows"]), has_survived_all(document["rows"])
    own["R1"] = [{"met": met, "figure": figure.rstrip("."), "by": goals.SOURCE, **run}]
    studied = goals.read_study_goals(folder)
    document["goals"] = {
        goal: reported for goal in goals.GOALS if (reported := [*own.get(goal, ()), *studied.get(goal, ())])
    }
    kills = folder / "kills.json"
    measured = json.loads(kills.read_text("utf-8"))["figures"] if kills.exists() else {}
    document["kills"] = {row: told for row, told in measured.get("sync_to_zero", {}).items() if row in ROWS}


def has_survived_all(rows: Mapping[str, Told]) -> bool:
    """Whether every row was tested without failure, enough of them on a real interface."""
    real = sum(told["real_passed"] > 0 for told in rows.values())
    return all(has_survived(told) == "yes" for told in rows.values()) and real >= LEAST_REAL


def has_survived(told: Told) -> str:
    """Return yes, no, or that the row was tested on a real interface only, or not at all."""
    if told["failed"] or told["real_failed"]:
        return "**no**"
    if told["passed"]:
        return "yes"
    return "on SocketCAN only" if told["real_passed"] else "not tested"


def format_time_to_zero(own: Sequence[int], studied: Mapping[str, float] | None) -> str:
    """Return the median and the worst SYNC count from fault to zero, empty where none was counted."""
    if studied is not None:
        return f"{studied['median']:g}, at worst {studied['worst']:g} of {studied['trials']:,}"
    if not own:
        return ""
    return f"{own[0]}" if len(set(own)) == 1 else f"{median(own):g}, at worst {max(own)} of {len(own)}"


def format_table(document: Mapping[str, Any]) -> list[str]:
    """Return the table of the rows in Markdown."""
    head = ["| row | fault | class | tests | on SocketCAN | SYNC to zero | survived |", "|---|---|---|--:|--:|---|---|"]
    return [*head, *(_format_line(row, told, document["kills"].get(row)) for row, told in document["rows"].items())]


def _format_line(row: str, told: Told, studied: Mapping[str, float] | None) -> str:
    classes = ", ".join(f"`{name}`" for name in ROWS[row].classes)
    note = f"{classes} ({TOLD_OTHERWISE[row]})" if row in TOLD_OTHERWISE else classes
    tests = told["passed"] + len(told["failed"])
    real = told["real_passed"] + len(told["real_failed"])
    zero = format_time_to_zero(told["sync_to_zero"], studied)
    cells = (row, ROWS[row].fault, note, tests or "", real or "", zero, has_survived(told))
    return "| " + " | ".join(map(str, cells)) + " |"


def summarise_matrix(rows: Mapping[str, Told]) -> str:
    """Return the figures in one sentence."""
    good = sum(has_survived(told) == "yes" for told in rows.values())
    bad = sum(has_survived(told) == "**no**" for told in rows.values())
    real = sum(told["real_passed"] > 0 for told in rows.values())
    reported = f"{good} of {len(rows)} rows survived, {bad} not, {len(rows) - good - bad} were not tested"
    return f"{reported}; {real} were tested on a real SocketCAN interface too."


def format_page(document: Mapping[str, Any]) -> str:
    run, found = document["run"], document["goals"]
    reported = f"{summarise_matrix(document['rows'])} Measured on {run['date']} at commit {run['commit']}."
    reached = (goals.summarise_goals(found), "", *goals.format_goal_lines(found))
    return "\n".join((HEAD, reported, "", *format_table(document), "", GOALS, *reached, ""))


def write_page(document: Mapping[str, Any], path: Path) -> None:
    path.with_suffix(".json").write_text(json.dumps(document, separators=(",", ":")) + "\n", "utf-8")
    path.write_text(format_page(document), "utf-8")


def read_provenance() -> dict[str, str]:
    """Return the day and the commit."""
    command = ["git", "-C", str(TESTS), "rev-parse", "--short", "HEAD"]
    asked = subprocess.run(command, capture_output=True, text=True, check=False)
    return {"date": datetime.now(UTC).strftime("%Y-%m-%d"), "commit": asked.stdout.strip() or "unknown"}


def main() -> None:
    document = json.loads(PAGE.with_suffix(".json").read_text("utf-8"))
    gather_outcomes(document, PAGE.parent)
    write_page(document, PAGE)
    sys.stdout.write(goals.summarise_goals(document["goals"]) + "\n")


if __name__ == "__main__":
    main()
