"""A complete machine on virtual time: the drives reach zero in time after any kill, hang or loss during a cut."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import pytest

from tests.guard.simulated_bus import ramp_cycles
from tests.machine.complete_machine import CompleteMachine
from tests.machine.invariants import TABLES, InvariantChecker
from tests.tiers import sampled

ROUND = "G1 X30 F6000\nG1 Y20\nG1 X0\nG1 Y0\n"
PART = f"G21 G90 G94\nG4 P0.2\n{ROUND * 2}G4 P0.2\nM2\n"
Begin = Callable[[], CompleteMachine]


def run_into_cut(machine: CompleteMachine, seconds: float = 0.0) -> None:
    """Arm a part and play it until an offset is applied for this time."""
    answer = machine.arm_program(machine.write_program(PART, "part.ngc"))
    assert answer["ok"], answer
    machine.play_program(PART, "part.ngc", wait=False)
    machine.run_for(seconds)
    machine.run_until(lambda: any(machine.read_offset_um().values()), step_s=0.013)


def compute_bound_s(machine: CompleteMachine) -> float:
    """Return the longest ramp to zero from the largest offset."""
    assert machine.guard is not None
    settings = machine.guard.settings
    return max(ramp_cycles(axis.limits, axis.limits.offset) for axis in settings.axes) * settings.sync_period_s


def measure_time_to_zero(machine: CompleteMachine, within_s: float) -> None:
    machine.run_for(within_s)
    assert not any(machine.read_offset_um().values())


def list_rows(machine: CompleteMachine) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(machine.config.store.directory / "history.sqlite")) as db:
        return [row for table in TABLES for row in db.execute(f"SELECT * FROM {table} ORDER BY id")]


def build_eventful_run(machine: CompleteMachine) -> Iterable[object]:
    """Cut, kill, adopt and lose frames; yield everything that must be reproducible."""
    run_into_cut(machine)
    machine.kill_process("daemon")
    machine.start_processes("daemon")
    machine.inject_fault("bus_mutate", axis="X", value=2, percent=20, duration_s=0.1)
    machine.run_for(0.3)
    machine.kill_process("guard")
    machine.start_processes("guard")
    machine.run_for(0.5)
    yield machine.request_daemon("status")["state"]
    machine.stop_processes("daemon")
    machine.stop_processes("guard")
    machine.bus.deliver_frames()
    yield machine.bus.frames
    yield machine.bus.digest.hexdigest()
    yield list_rows(machine)
    yield machine.log.getvalue()
    yield machine.journal


def test_the_same_seed_gives_the_same_frames_history_and_log(start_machine: Begin) -> None:
    first = list(build_eventful_run(start_machine()))
    again = list(build_eventful_run(start_machine()))
    assert again == first
    assert len(str(first[4])) > 300


def test_different_seed_gives_different_frames(tmp_path: Path) -> None:
    digests = set()
    for seed in (1, 1, 2):
        with CompleteMachine(seed, folder=tmp_path) as machine:
            machine.switch_nc(on=True)
            machine.run_for(0.2)
            machine.bus.deliver_frames()
            digests.add(machine.bus.digest.hexdigest())
    assert len(digests) == 2


@pytest.mark.fault("F15")
@pytest.mark.parametrize("seconds", sampled([0.0, 0.8, 1.3], every=3))
def test_offsets_ramp_to_zero_when_the_daemon_is_killed(start_machine: Begin, seconds: float) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    run_into_cut(machine, seconds)
    machine.kill_process("daemon")
    measure_time_to_zero(machine, compute_bound_s(machine) + 0.005)
    machine.start_processes("daemon")
    machine.run_for(0.7)
    status = judge.check_status()
    assert (status["state"], status["guard"]["cause"]["code"]) == ("OFF", "MainLost")
    machine.stop_processes("daemon")
    judge.check_end()
    assert machine.wrong == []


@pytest.mark.fault("F14")
def test_offsets_ramp_to_zero_when_the_daemon_hangs(start_machine: Begin) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    run_into_cut(machine)
    assert machine.guard is not None
    machine.hang_process("daemon", machine.guard.settings.daemon_lost_s + compute_bound_s(machine) + 0.005)
    assert not any(machine.read_offset_um().values())
    machine.run_for(1.0)
    assert judge.check_status()["guard"]["cause"]["code"] == "MainLost"
    assert machine.wrong == []


@pytest.mark.fault("F14")
def test_hung_guard_sends_nothing_and_ramps_to_zero_when_it_resumes(start_machine: Begin) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    run_into_cut(machine)
    sent, held = judge.counted["offset frames"], machine.read_offset_um()
    machine.hang_process("guard", 0.1)
    assert judge.counted["offset frames"] <= sent + 4
    assert machine.read_offset_um() == pytest.approx(held, abs=25.0)
    measure_time_to_zero(machine, compute_bound_s(machine) + 0.02)
    machine.run_for(0.6)
    assert judge.check_status()["guard"]["cause"]["code"] == "LoopOverrun"
    assert machine.wrong == []


@pytest.mark.fault("E13", "F16")
def test_new_guard_adopts_offset_of_killed_guard(start_machine: Begin) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    run_into_cut(machine)
    machine.kill_process("guard")
    machine.run_for(0.3)
    assert any(machine.read_offset_um().values())  # a drive keeps the last offset that it received
    machine.start_processes("guard")
    measure_time_to_zero(machine, 1.5)
    status = judge.check_status()
    assert status["may_stand"]["nothing"]
    assert status["guard"]["cause"]["code"] == "StaleOffset"
    assert machine.wrong == []


@pytest.mark.fault("F16")
def test_restarted_guard_ramps_to_zero_before_exit(start_machine: Begin) -> None:
    machine = start_machine()
    InvariantChecker(machine)
    run_into_cut(machine, 0.4)
    machine.stop_processes("guard")
    assert machine.guard_exit == 0
    assert not any(machine.read_offset_um().values())
    machine.start_processes("guard")
    machine.run_for(0.5)
    assert machine.read_guard_state == "OFF"
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
def test_fault_during_cut_ends_at_zero_offset(start_machine: Begin, kind: str, fields: dict[str, object]) -> None:
    machine = start_machine()
    judge = InvariantChecker(machine)
    run_into_cut(machine)
    machine.inject_fault(kind, duration_s=0.3, **fields)
    machine.run_for(2.0)
    assert machine.guard is not None
    if machine.guard.state.mode.value == "FROZEN":
        machine.attest_facts()
        answer = machine.adopt_offset()
        assert answer["ok"], answer
        machine.run_for(0.5)
    assert not any(machine.read_offset_um().values())
    machine.run_for(1.0)
    assert judge.check_status()["armed"] is None
    assert machine.wrong == []


def test_guard_sleeps_without_sync(start_machine: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = start_machine()
    machine.switch_nc(on=False)
    machine.run_for(0.5)
    assert machine.guard is not None
    turns: list[float] = []
    turn = machine.guard.run_turn

    def count_wakeups() -> int | None:
        turns.append(machine.clock.now_s())
        return turn()

    monkeypatch.setattr(machine.guard, "run_turn", count_wakeups)
    machine.run_for(5.0)
    assert 50 < len(turns) < 500  # it looks 20 times a second, and when it is asked
