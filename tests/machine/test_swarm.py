"""The swarm reproduces a run from its seed, and its checker detects violations."""

from __future__ import annotations

import json
import random
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from fdhil.guard import guard_step
from studies import swarm
from tests.machine.complete_machine import CompleteMachine
from tests.machine.invariants import InvariantChecker
from tests.machine.test_failures_in_cut import run_into_cut

Begin = Callable[[], CompleteMachine]
RUN = {"command": "python -m studies.swarm", "commit": "0123abcd", "date": "2026-11-28", "versions": "Python 3.11"}


@pytest.mark.usefixtures("long_computation")
def test_seed_reproduces_complete_run(tmp_path: Path) -> None:
    lives = []
    for _ in range(2):
        folder = tmp_path / "life"
        folder.mkdir()
        wrong, counted, machine = swarm.run_machine_life(4, 12.0, folder)
        assert wrong == []
        lives.append((counted, machine.bus.digest.hexdigest(), machine.log.getvalue(), machine.journal))
        folder.rename(tmp_path / f"before-{len(lives)}")
    assert lives[0] == lives[1]


def test_failure_names_reproducing_command() -> None:
    figures = swarm.make_empty_figures("code")
    swarm.add_life(figures, 17, 60.0, ["1.000 s: a step"], {"SYNC": 3, "frames": 9, "milliseconds": 70}, 2.0)
    page = swarm.page({**RUN, "seeds": "17 to 17"}, figures)
    assert "`make swarm N=1 SEED=17 SECONDS=60`: 1.000 s: a step" in page
    assert "Broken: in all 1 machines." in page


def test_run_adds_to_total_of_same_code(tmp_path: Path) -> None:
    path = tmp_path / "swarm.json"
    for seed in (1, 2):
        figures = swarm.load_figures(path, "code")
        assert swarm.find_next_seed(figures) == seed
        swarm.add_life(figures, seed, 60.0, [], {"SYNC": 3, "frames": 9, "milliseconds": 70_000}, 2.0)
        swarm.write_results(path, RUN, figures)
    figures = json.loads(path.read_text("utf-8"))["figures"]
    assert (figures["runs"], figures["machines"], figures["counted"]["SYNC"]) == ([[1, 2, 60.0]], 2, 6)
    assert swarm.is_counted(figures, 2, 60.0)
    assert not swarm.is_counted(figures, 2, 20.0)
    text = " ".join(path.with_suffix(".md").read_text("utf-8").split())
    assert "140 machine-seconds in 4 s of processor time" in text


def test_run_of_other_code_starts_new_total_and_lists_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "swarm.json"
    figures = swarm.make_empty_figures("before")
    swarm.add_life(figures, 1, 60.0, ["2.0 s: wrong"], {"milliseconds": 70_000}, 2.0)
    path.write_text(json.dumps({"run": RUN, "figures": figures}), "utf-8")
    again = swarm.load_figures(path, "after")
    assert (again["machines"], again["runs"], again["failures"]) == (0, [], [])
    assert again["earlier"] == [{"commit": "0123abcd", "machines": 1, "machine_s": 70.0, "failures": 1}]


# where the signal comes within a callback of the garbage collector, its exception ends there; the run still reports it
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_endless_run_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(swarm, "MOST_CPU_S", 0.02)
    handler = signal.signal(signal.SIGPROF, swarm._too_long)
    try:
        _, wrong, _, _ = swarm.assess_life(1, 1.0)
    finally:
        signal.signal(signal.SIGPROF, handler)
    assert any("more than 0.02 s of processor time" in each for each in wrong), wrong


def test_every_event_occurs_during_cut(start_machine: Begin) -> None:
    machine = start_machine()
    life = swarm.Life(1, 1.0, machine, InvariantChecker(machine), random.Random(1))
    for name in sorted(swarm.EVENTS.keys() - {"daemon restarted", "guard restarted", "feed held"}):
        swarm.EVENTS[name](life)
        machine.run_for(0.002)
    assert machine.wrong == []


def test_checker_detects_offset_step(start_machine: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = start_machine()
    InvariantChecker(machine)
    run_into_cut(machine, 0.3)
    monkeypatch.setattr(guard_step, "move_toward_goal", lambda _limits, _offset, _rate, wanted, _rate_wanted: wanted)
    monkeypatch.setattr(guard_step, "find_limit_violation", lambda _limits, _before, _rate, _offset: None)
    machine.run_for(0.1)
    machine.kill_process("daemon")
    machine.run_for(0.1)
    assert any("a step" in each for each in machine.wrong), machine.wrong


def test_checker_detects_unreported_residual_offset(start_machine: Begin) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    machine.inject_fault("object", axis="X", index=0x60B0, value=100)
    machine.inject_fault("drop_tpdo", axis="X", value=3)
    machine.run_for(1.8)
    judge.check_status()
    judge.check_end()
    assert any("in the end the drives hold" in each for each in machine.wrong), machine.wrong
