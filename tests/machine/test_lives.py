"""A complete machine on virtual time: the drives reach zero in time after any kill, hang or loss during a cut."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import pytest

from tests.guard.simulated_bus import ramp_cycles
from tests.machine.invariants import TABLES, Judge
from tests.machine.whole_machine import Machine
from tests.tiers import sampled

ROUND = "G1 X30 F6000\nG1 Y20\nG1 X0\nG1 Y0\n"
PART = f"G21 G90 G94\nG4 P0.2\n{ROUND * 2}G4 P0.2\nM2\n"
Begin = Callable[[], Machine]


def into_the_cut(machine: Machine, seconds: float = 0.0) -> None:
    """Arm a part and play it until an offset is applied for this time."""
    answer = machine.arm(machine.write(PART, "part.ngc"))
    assert answer["ok"], answer
    machine.play(PART, "part.ngc", wait=False)
    machine.run(seconds)
    machine.run_until(lambda: any(machine.held_um().values()), step_s=0.013)


def bound_s(machine: Machine) -> float:
    """Return the longest ramp to zero from the largest offset."""
    assert machine.guard is not None
    settings = machine.guard.settings
    return max(ramp_cycles(axis.limits, axis.limits.offset) for axis in settings.axes) * settings.sync_period_s


def comes_to_zero(machine: Machine, within_s: float) -> None:
    machine.run(within_s)
    assert not any(machine.held_um().values())


def rows(machine: Machine) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(machine.config.store.directory / "history.sqlite")) as db:
        return [row for table in TABLES for row in db.execute(f"SELECT * FROM {table} ORDER BY id")]


def eventful(machine: Machine) -> Iterable[object]:
    """Cut, kill, adopt and lose frames; yield everything that must be reproducible."""
    into_the_cut(machine)
    machine.kill("daemon")
    machine.start("daemon")
    machine.fault("bus_mutate", axis="X", value=2, percent=20, duration_s=0.1)
    machine.run(0.3)
    machine.kill("guard")
    machine.start("guard")
    machine.run(0.5)
    yield machine.ask("status")["state"]
    machine.stop("daemon")
    machine.stop("guard")
    machine.bus.flush()
    yield machine.bus.frames
    yield machine.bus.digest.hexdigest()
    yield rows(machine)
    yield machine.log.getvalue()
    yield machine.journal


def test_the_same_seed_gives_the_same_frames_history_and_log(begin: Begin) -> None:
    first = list(eventful(begin()))
    again = list(eventful(begin()))
    assert again == first
    assert len(str(first[4])) > 300


def test_another_seed_gives_other_frames(tmp_path: Path) -> None:
    digests = set()
    for seed in (1, 1, 2):
        with Machine(seed, folder=tmp_path) as machine:
            machine.nc(on=True)
            machine.run(0.2)
            machine.bus.flush()
            digests.add(machine.bus.digest.hexdigest())
    assert len(digests) == 2


@pytest.mark.fault("F15")
@pytest.mark.parametrize("seconds", sampled([0.0, 0.8, 1.3], every=3))
def test_offsets_ramp_to_zero_when_the_daemon_is_killed(begin: Begin, seconds: float) -> None:
    machine = begin()
    judge = Judge(machine)
    into_the_cut(machine, seconds)
    machine.kill("daemon")
    comes_to_zero(machine, bound_s(machine) + 0.005)
    machine.start("daemon")
    machine.run(0.7)
    status = judge.status()
    assert (status["state"], status["guard"]["cause"]["code"]) == ("OFF", "MainLost")
    machine.stop("daemon")
    judge.end()
    assert machine.wrong == []


@pytest.mark.fault("F14")
def test_offsets_ramp_to_zero_when_the_daemon_hangs(begin: Begin) -> None:
    machine = begin()
    judge = Judge(machine)
    into_the_cut(machine)
    assert machine.guard is not None
    machine.hang("daemon", machine.guard.settings.daemon_lost_s + bound_s(machine) + 0.005)
    assert not any(machine.held_um().values())
    machine.run(1.0)
    assert judge.status()["guard"]["cause"]["code"] == "MainLost"
    assert machine.wrong == []


@pytest.mark.fault("F14")
def test_a_hung_guard_sends_nothing_and_ramps_down_when_it_goes_on(begin: Begin) -> None:
    machine = begin()
    judge = Judge(machine)
    into_the_cut(machine)
    sent, held = judge.counted["offset frames"], machine.held_um()
    machine.hang("guard", 0.1)
    assert judge.counted["offset frames"] <= sent + 4
    assert machine.held_um() == pytest.approx(held, abs=25.0)
    comes_to_zero(machine, bound_s(machine) + 0.02)
    machine.run(0.6)
    assert judge.status()["guard"]["cause"]["code"] == "LoopOverrun"
    assert machine.wrong == []


@pytest.mark.fault("E13", "F16")
def test_a_new_guard_takes_over_what_a_killed_one_left(begin: Begin) -> None:
    machine = begin()
    judge = Judge(machine)
    into_the_cut(machine)
    machine.kill("guard")
    machine.run(0.3)
    assert any(machine.held_um().values())  # a drive keeps the last offset that it received
    machine.start("guard")
    comes_to_zero(machine, 1.5)
    status = judge.status()
    assert status["may_stand"]["nothing"]
    assert status["guard"]["cause"]["code"] == "StaleOffset"
    assert machine.wrong == []


@pytest.mark.fault("F16")
def test_a_restarted_guard_ramps_to_zero_before_it_ends(begin: Begin) -> None:
    machine = begin()
    Judge(machine)
    into_the_cut(machine, 0.4)
    machine.stop("guard")
    assert machine.guard_exit == 0
    assert not any(machine.held_um().values())
    machine.start("guard")
    machine.run(0.5)
    assert machine.guard_state == "OFF"
    assert machine.wrong == []


@pytest.mark.parametrize(
    ("kind", "fields"),
    sampled([
        ("drop_tpdo", {"axis": "X", "value": 3}),
        ("bus_mutate", {"can_id": 0x381, "value": 3, "percent": 50}),
        ("sync_lost", {}),
        ("ignore_offset", {"axis": "Y"}),
        ("trip", {"axis": "X", "value": 0x3210}),
        ("bus_down", {}),
    ], every=3),
)  # fmt: skip
def test_a_fault_in_the_cut_ends_at_zero(begin: Begin, kind: str, fields: dict[str, object]) -> None:
    machine = begin()
    judge = Judge(machine)
    into_the_cut(machine)
    machine.fault(kind, duration_s=0.3, **fields)
    machine.run(2.0)
    assert machine.guard is not None
    if machine.guard.state.mode.value == "FROZEN":
        machine.attest()
        answer = machine.adopt()
        assert answer["ok"], answer
        machine.run(0.5)
    assert not any(machine.held_um().values())
    machine.run(1.0)
    assert judge.status()["armed"] is None
    assert machine.wrong == []


def test_the_guard_sleeps_while_no_sync_comes(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = begin()
    machine.nc(on=False)
    machine.run(0.5)
    assert machine.guard is not None
    turns: list[float] = []
    turn = machine.guard.run_turn

    def counted() -> int | None:
        turns.append(machine.clock.now_s())
        return turn()

    monkeypatch.setattr(machine.guard, "run_turn", counted)
    machine.run(5.0)
    assert 50 < len(turns) < 500  # it looks 20 times a second, and when it is asked
