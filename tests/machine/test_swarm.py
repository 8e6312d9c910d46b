"""The swarm repeats a life from its seed, and its judge sees what is wrong."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from fdhil.guard import core
from studies import swarm
from tests.machine.invariants import Judge
from tests.machine.test_lives import into_the_cut
from tests.machine.whole_machine import Machine

Begin = Callable[[], Machine]


@pytest.mark.usefixtures("long_computation")
def test_a_seed_repeats_a_whole_life(tmp_path: Path) -> None:
    lives = []
    for _ in range(2):
        folder = tmp_path / "life"
        folder.mkdir()
        wrong, counted, machine = swarm.life_of(4, 12.0, folder)
        assert wrong == []
        lives.append((counted, machine.bus.digest.hexdigest(), machine.log.getvalue(), machine.journal))
        folder.rename(tmp_path / f"before-{len(lives)}")
    assert lives[0] == lives[1]


def test_a_failure_names_the_command_that_repeats_it() -> None:
    assert swarm.replay(17, 60.0) == "make swarm N=1 SEED=17 SECONDS=60"


def test_every_event_can_happen_to_a_machine_that_cuts(begin: Begin) -> None:
    machine = begin()
    life = swarm.Life(1, 1.0, machine, Judge(machine), random.Random(1))
    for name in sorted(swarm.EVENTS.keys() - {"daemon restarted", "guard restarted", "feed held"}):
        swarm.EVENTS[name](life)
        machine.run(0.002)
    assert machine.wrong == []


def test_a_step_of_the_offset_is_seen_by_the_judge(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = begin()
    Judge(machine)
    into_the_cut(machine, 0.3)
    monkeypatch.setattr(core, "follow", lambda _limits, _offset, _rate, wanted, _rate_wanted: wanted)
    monkeypatch.setattr(core, "violation", lambda _limits, _before, _rate, _offset: None)
    machine.run(0.1)
    machine.kill("daemon")
    machine.run(0.1)
    assert any("a step" in each for each in machine.wrong), machine.wrong


def test_an_offset_that_stays_and_is_denied_is_seen_by_the_judge(begin: Begin) -> None:
    machine = begin()
    judge = Judge(machine)
    machine.fault("object", axis="X", index=0x60B0, value=100)
    machine.fault("drop_tpdo", axis="X", value=3)
    machine.run(1.8)
    judge.status()
    judge.end()
    assert any("in the end the drives hold" in each for each in machine.wrong), machine.wrong
