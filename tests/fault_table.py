"""Pytest plugin behind ``make faults``: runs what carries the marker ``fault`` and tells it row by row.

``--fault-table PATH`` prints the table at the end and writes PATH (a page) with its figures beside it (.json).
"""

from __future__ import annotations

import json
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from tests.fault_matrix import ROWS, TESTS, TOLD_OTHERWISE, UNTESTED

ELSEWHERE = ("socketcan", "debian")
HEAD = """# The fault matrix, row by row

Written by `make faults`: each fault that may happen to the machine, the bus, the sensors, the disk, the operator or the
network, the class that tells it, and whether fdhil survived it, that is, whether every test of the row passed. A row
counts as tested only where a test sees the safe reaction. What runs on a real SocketCAN interface (`make test-vcan`) or
with programs of others (`make test-full`) is counted beside and not run here.
"""


class FaultTable:
    """What became of each row's tests."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: dict[str, dict[str, Any]] = {
            row: {"passed": 0, "failed": [], **dict.fromkeys(ELSEWHERE, 0)} for row in ROWS
        }
        self._rows_of: dict[str, tuple[str, ...]] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Note which rows each test proves, before those of other places are put aside."""
        for item in items:
            rows = rows_proven(item)
            place = next((name for name in ELSEWHERE if item.get_closest_marker(name)), None)
            if place is None:
                self._rows_of[item.nodeid] = rows
            else:
                for row in rows:
                    self.rows[row][place] += 1

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test that ran, and one that failed before or after it did."""
        for row in self._rows_of.get(report.nodeid, ()):
            if report.failed:
                self.rows[row]["failed"].append(report.nodeid)
            elif report.passed and report.when == "call":
                self.rows[row]["passed"] += 1

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the table and write the page."""
        terminalreporter.section("fault matrix")
        for line in table(self.rows):
            terminalreporter.write_line(line)
        terminalreporter.write_line(summary(self.rows))
        document = {"run": provenance(), "rows": self.rows}
        self.path.with_suffix(".json").write_text(json.dumps(document, separators=(",", ":")) + "\n", "utf-8")
        self.path.write_text(page(document), "utf-8")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that asks for the table."""
    parser.addoption("--fault-table", type=Path, help="run nothing else, but tell each row of the fault matrix in PATH")


def pytest_configure(config: pytest.Config) -> None:
    """Tell the rows where it was asked for."""
    if path := config.getoption("--fault-table"):
        config.pluginmanager.register(FaultTable(path), "fault-table-rows")


def rows_proven(item: pytest.Item) -> tuple[str, ...]:
    """Return the rows of a test; a case of a parametrized one whose id begins with a row's proves that one alone."""
    rows = {row for mark in item.iter_markers("fault") for row in mark.args}
    if unknown := rows - ROWS.keys():
        raise pytest.UsageError(f"{item.nodeid} names {sorted(unknown)}, which the fault matrix does not have")
    case = item.name.partition("[")[2].rstrip("]").split(" ")[0].split("-")[0]
    return (case,) if case in rows else tuple(sorted(rows))


def survived(row: str, told: dict[str, Any]) -> str:
    """Return yes, no, or where the row is tested instead."""
    if told["failed"]:
        return "**no**"
    if told["passed"]:
        return "yes"
    return next((f"on {place} only" for place in ELSEWHERE if told[place]), f"no test: {UNTESTED.get(row, 'lost')}")


def table(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Return the table in Markdown."""
    lines = ["| row | fault | class | tests | on SocketCAN | survived |", "|---|---|---|--:|--:|---|"]
    for row, told in rows.items():
        classes = ", ".join(f"`{name}`" for name in ROWS[row].classes)
        note = f"{classes} ({TOLD_OTHERWISE[row]})" if row in TOLD_OTHERWISE else classes
        tests = told["passed"] + len(told["failed"]) + told["debian"]
        cells = (row, ROWS[row].fault, note, tests or "", told["socketcan"] or "", survived(row, told))
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return lines


def summary(rows: dict[str, dict[str, Any]]) -> str:
    """Return the figures in one sentence."""
    good = sum(survived(row, told) == "yes" for row, told in rows.items())
    bad = sum(bool(told["failed"]) for told in rows.values())
    real = sum(bool(told["socketcan"]) for told in rows.values())
    left = len(rows) - good - bad
    told = f"{good} of {len(rows)} rows survived, {bad} not, {left} without a test here"
    return f"{told}; {real} have a test on a real SocketCAN interface."


def page(document: dict[str, Any]) -> str:
    """Return the page that the figures make."""
    rows, run = document["rows"], document["run"]
    told = f"{summary(rows)} Measured on {run['date']} at commit {run['commit']}."
    return "\n".join((HEAD, told, "", *table(rows), ""))


def provenance() -> dict[str, str]:
    """Return the day and the commit."""
    command = ["git", "-C", str(TESTS), "rev-parse", "--short", "HEAD"]
    asked = subprocess.run(command, capture_output=True, text=True, check=False)
    return {"date": datetime.now(UTC).strftime("%Y-%m-%d"), "commit": asked.stdout.strip() or "unknown"}
