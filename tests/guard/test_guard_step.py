"""One correction through the guard's core, checked on the frames that leave."""

from __future__ import annotations

import copy

import pytest

from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardRequest, StepInputs
from fdhil.guard.interlocks import Alarm
from fdhil.guard.state_transitions import ZEROS
from tests.guard.simulated_bus import DIGEST, Bench, bench, ramp_cycles


@pytest.fixture
def armed_machine() -> Bench:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    return machine


def test_guard_sends_nothing_until_armed() -> None:
    machine = bench()
    machine.settle(300)
    assert machine.frames == []
    assert machine.heartbeats == []
    assert machine.mode is Mode.OFF


def test_armed_guard_sends_zeros_and_its_heartbeat(armed_machine: Bench) -> None:
    armed_machine.run(100)
    assert armed_machine.mode is Mode.ARMED
    assert {offsets for _, offsets in armed_machine.frames} == {(0, 0)}
    assert len(armed_machine.frames) == 101
    assert [b - a for a, b in zip(armed_machine.heartbeats, armed_machine.heartbeats[1:], strict=False)] == [20] * 4


def test_offsets_match_their_rows_exactly(armed_machine: Bench) -> None:
    assert armed_machine.path is not None
    armed_machine.run(30)
    armed_machine.play()
    latched: list[tuple[int, int]] = []
    for _ in range(560):
        armed_machine.run_sync()
        latched.append((armed_machine.drives[0].target, armed_machine.drives[0].offset))
    demand, offset = armed_machine.path.demand[0], armed_machine.path.offset[0]
    rows = {target: k for k, target in enumerate(demand)}
    moving = [(target, sent) for target, sent in latched if demand[45] < target < demand[-45]]
    assert len(moving) > 400
    assert all(sent == offset[rows[target]] for target, sent in moving)
    assert armed_machine.state.missed == 0


def test_path_end_ramps_to_zero_and_goes_off(armed_machine: Bench) -> None:
    armed_machine.run(30)
    armed_machine.play()
    armed_machine.run_until(Mode.ACTIVE)
    armed_machine.run_until(Mode.OFF)
    assert armed_machine.alarms[-1].code == "Finished"
    assert armed_machine.state.places == ()
    assert armed_machine.offsets == (0, 0)
    count = len(armed_machine.frames)
    armed_machine.run(50)
    assert len(armed_machine.frames) == count


def test_ramp_begins_after_the_last_row(armed_machine: Bench) -> None:
    path = armed_machine.path
    assert path is not None
    demand, offset = (tuple(column[:200] for column in columns) for columns in (path.demand, path.offset))
    assert offset[0][-1] > offset[0][-2]
    armed_machine.path = CorrectedPath(0, demand, offset, True, DIGEST, 1)
    armed_machine.run(30)
    armed_machine.play()
    armed_machine.run_until(Mode.RAMP_DOWN)
    sent = {tick: offsets[0] for tick, offsets in armed_machine.frames}
    assert sent[armed_machine.tick - 1] == offset[0][-1]
    assert sent[armed_machine.tick] != offset[0][-1]
    assert armed_machine.drives[0].target == demand[0][-1]


def test_cause_of_the_end_is_reported_once_with_its_class(armed_machine: Bench) -> None:
    for kind, code in (("stop", "Stopped"), ("disarm", "Disarmed")):
        machine = copy.deepcopy(armed_machine)
        result = [machine.run_sync().transition for _ in range(5)]
        assert result == [None] * 5
        assert machine.run_sync(GuardRequest("stop" if kind == "stop" else "disarm")).transition == (
            *(Mode.ARMED, Mode.RAMP_DOWN),
            Alarm(code),
        )
        machine.run_until(Mode.OFF)
        assert machine.state.cause == Alarm(code)
        assert machine.state.places == ()
        assert machine.arm() == ()
        assert machine.state.cause is None


def test_each_ramp_down_sends_its_own_zeros(armed_machine: Bench) -> None:
    for _ in range(2):
        armed_machine.run(25)
        before = len(armed_machine.frames)
        armed_machine.run_sync(GuardRequest("disarm"))
        armed_machine.run_until(Mode.OFF)
        assert len(armed_machine.frames) - before == ZEROS + 1
        armed_machine.settle(5)
        assert armed_machine.arm() == ()


def test_not_settled_refusal_has_the_number_of_good_cycles() -> None:
    machine = bench()
    machine.settle(30)
    machine.drives[0].mode = 1
    machine.settle(11)
    machine.drives[0].mode = 8
    while machine.state.good_for == 0:
        machine.run_sync()
    machine.run(9)
    (refused,) = machine.arm()
    assert refused == Alarm("NotSettled", detail="11 so far")


def test_first_withdrawn_fact_is_the_cause(armed_machine: Bench) -> None:
    axes, bus = armed_machine.listener.receive_at_sync(
        bytes([armed_machine.counter + 1]), (armed_machine.tick + 1) * 1e-3, (armed_machine.tick + 1) * 1e-3
    )
    withdrawn = (Alarm("ModelStale"), Alarm("PoorSkill"))
    armed_machine.decide_and_check(StepInputs(True, axes, bus, withdrawn=withdrawn, path=armed_machine.path))
    assert (armed_machine.mode, armed_machine.state.cause) == (Mode.RAMP_DOWN, Alarm("ModelStale"))


@pytest.mark.fault("E18")
def test_disarm_during_the_cut_ramps_down(armed_machine: Bench) -> None:
    armed_machine.run(30)
    armed_machine.play()
    armed_machine.run_until(Mode.ACTIVE)
    armed_machine.run(250)
    start = armed_machine.offsets[0]
    assert start > 200
    armed_machine.run_sync(GuardRequest("disarm"))
    assert armed_machine.mode is Mode.RAMP_DOWN
    taken = 1
    while armed_machine.offsets != (0, 0):
        armed_machine.run_sync()
        taken += 1
    assert taken <= ramp_cycles(armed_machine.settings.axes[0].limits, start)
    armed_machine.run_until(Mode.OFF)
    assert armed_machine.alarms[-1].code == "Disarmed"
