"""The mutation study: it creates mutants at the stated locations and detects failing tests."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from studies import mutants
from studies.mutation import Mutant, apply_mutant, find_function, mutate_code, mutate_values
from studies.trial import UNCALLED, UNNOTICED

ROOT = Path(__file__).parent.parent
LIMITS = "fdhil.guard.offset_limits"


@pytest.mark.usefixtures("long_computation")
def test_mutants_cover_functions_properties_tables_and_constants() -> None:
    import_module("fdhil.guard.guard_step")  # only what is loaded is searched for who reads a table
    code = {mutant.name for mutant in mutate_code(LIMITS)}
    assert "offset_limits.limit_value: return min(max(value, low), high) -> return min(max(value, low), None)" in code
    total = "return self.current + sum(self.past)"
    assert f"offset_limits.OffsetTravel.total: {total} -> {total.replace('+', '-')}" in code
    assert "offset_limits.CEILING_OFFSET_UM: 250 -> 251" in {mutant.name for mutant in mutate_values(LIMITS)}
    assert not {mutant.place for mutant in mutate_values("fdhil.guard.state_transitions")} & {"SENT", "TRANSITIONS"}
    rows = {mutant.name for mutant in mutate_values("fdhil.guard.interlocks")}
    assert "interlocks.INTERLOCK_CATALOGUE: BusOff: FREEZE -> REFUSE" in rows
    assert "interlocks.FACTS: model_fresh -> no such row" in rows
    predicates = {mutant.place for mutant in mutate_code("fdhil.guard.interlock_checks")}
    assert "AXIS_INTERLOCKS[StaleData]" in predicates


def test_mutant_replaces_imported_names() -> None:
    from fdhil.guard.offset_limits import limit_value

    source = "def limit_value(value, low, high):\n    return max(max(value, low), high)\n"
    turned = Mutant(LIMITS, "limit_value", "", "", source)
    function, code = limit_value, find_function(LIMITS, "limit_value").__code__
    try:
        apply_mutant(turned)
        assert function(5, 1, 3) == 5
    finally:
        limit_value.__code__ = code
    assert function(5, 1, 3) == 3


@pytest.mark.usefixtures("processes")
def test_mutants_are_detected_by_tests_of_the_function(tmp_path: Path) -> None:
    """The study on a small module: called and checked code is detected, uncalled code is reported."""
    options = ["--modules", "request_parsing", "--every", "12", "--tests", "tests/guard/test_request_parsing.py"]
    command = [sys.executable, "-m", "studies.mutants", *options, "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads((tmp_path / "mutants.json").read_text("utf-8"))["figures"]
    noticed, total = mutants.sum_detected(figures["modules"], "code")
    assert 0.3 * total < noticed < total
    assert {row["result"] for row in figures["left"]} == {UNNOTICED, UNCALLED}
    assert not figures["goals"]["R11"]["met"]
    assert (tmp_path / "mutants.md").read_text("utf-8").startswith("# What the guard's tests notice")
