"""A short ``make fuzz`` in every test run: valid examples, past findings, and some hundred mutated examples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from studies import fuzz, slips
from tests.fuzz import TARGETS, input_assessment
from tests.fuzz.input_assessment import Target, assess_input, list_found_inputs
from tests.fuzz.mutation import generate_mutants
from tests.fuzz.targets import load_target

FEW = {"recording_mdf4": 2, "hearing": 60, "guard_can": 60, "status_told": 60}
MANY = 100
SLOW = [{"kind": "slow", "place": "x", "inputs": 1}]


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("name", TARGETS)
def test_valid_and_mutated_examples_have_declared_answers(name: str) -> None:
    target = load_target(name)
    for data in [*target.seeds, *generate_mutants(target, FEW.get(name, MANY), seed=1)]:
        finding = assess_input(target, data)
        assert finding is None, (data, finding)


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize(
    "path", [path for name in TARGETS for path in list_found_inputs(name)], ids=lambda p: f"{p.parent.name}-{p.name}"
)
def test_past_findings_are_fixed(path: Path) -> None:
    finding = assess_input(load_target(path.parent.name), path.read_bytes())
    assert finding is None, finding


@pytest.mark.usefixtures("long_computation")
def test_undeclared_answer_is_a_finding() -> None:
    """Also an input that never ends, and one that uses too much memory."""

    def taste(data: bytes) -> None:
        if data == b"for ever":
            while True:
                pass
        if data == b"slow":
            sum(range(10_000_000))
        if data == b"large":
            bytearray(64 << 20)
        raise KeyError(data)

    def kind(data: bytes) -> str:
        finding = assess_input(Target("made up", [], taste), data)
        assert finding is not None
        return finding.kind

    with pytest.MonkeyPatch.context() as changed:
        changed.setattr(input_assessment, "GIVEN_UP_S", 0.2)
        assert [kind(data) for data in (b"x", b"for ever")] == ["KeyError", "slow"]


@pytest.mark.usefixtures("long_computation")
def test_single_typo_changes_only_mistyped_value() -> None:
    text = slips.SAMPLE.read_text("utf-8")
    counts, wrong = slips.count_outcomes(slips.sample_slips(text, 500, seed=2), text)
    assert wrong == []
    assert min(counts[outcome] for outcome in ("same", "refused", "value")) > 0


def test_runs_accumulate_and_goals_list_findings() -> None:
    one = {"inputs": 600_000, "cpu_s": 1.0, "slowest_s": 0.5, "peak_mib": 9.0, "found": SLOW}
    two = {**one, "slowest_s": 0.1, "found": []}
    parts = {name: fuzz.merge_figures(fuzz.merge_figures(None, one), two) for name in TARGETS}
    assert parts["web"] == {"inputs": 1_200_000, "cpu_s": 2.0, "slowest_s": 0.5, "peak_mib": 9.0, "found": []}
    letters = {"count": 3, "all": True, "outcomes": {"same": 2, "refused": 1}, "wrong": [], "met": True}
    figures: dict[str, Any] = {"targets": parts, "mended": {"web": ["a-b"]}, "slips": letters}
    assert {goal: said["met"] for goal, said in fuzz.evaluate_goals(figures).items()} == {"R12": True, "R17": True}
    run = {"command": "c", "commit": "d", "date": "e", "versions": "v", "seeds": "1"}
    assert "None of them" in fuzz.page(run, figures)
    figures["targets"] = parts | {"web": fuzz.merge_figures(two, one)}
    figures["slips"] = letters | {"met": False, "wrong": ["elsewhere: 'x'"], "outcomes": {"elsewhere": 3}}
    assert {goal: said["met"] for goal, said in fuzz.evaluate_goals(figures).items()} == {"R12": False, "R17": False}
    assert "slow at x" in fuzz.page(run, figures)
