"""One correction through the guard's core, checked on the frames that leave."""

from __future__ import annotations

import copy

import pytest

from fdhil.guard.interlocks import Alarm
from fdhil.guard.path import CorrectedPath
from fdhil.guard.protocol import Mode
from fdhil.guard.state import Inputs, Request
from fdhil.guard.transitions import ZEROS
from tests.guard.machine import DIGEST, Bench, bench, ramp_cycles


@pytest.fixture
def armed() -> Bench:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    return machine


def test_mute_until_armed() -> None:
    machine = bench()
    machine.settle(300)
    assert machine.frames == []
    assert machine.heartbeats == []
    assert machine.mode is Mode.OFF


def test_armed_sends_zeros_and_its_heartbeat(armed: Bench) -> None:
    armed.run(100)
    assert armed.mode is Mode.ARMED
    assert {offsets for _, offsets in armed.frames} == {(0, 0)}
    assert len(armed.frames) == 101
    assert [b - a for a, b in zip(armed.heartbeats, armed.heartbeats[1:], strict=False)] == [20] * 4


def test_offsets_meet_their_rows_exactly(armed: Bench) -> None:
    assert armed.path is not None
    armed.run(30)
    armed.play()
    latched: list[tuple[int, int]] = []
    for _ in range(560):
        armed.sync()
        latched.append((armed.drives[0].target, armed.drives[0].offset))
    demand, offset = armed.path.demand[0], armed.path.offset[0]
    rows = {target: k for k, target in enumerate(demand)}
    moving = [(target, sent) for target, sent in latched if demand[45] < target < demand[-45]]
    assert len(moving) > 400
    assert all(sent == offset[rows[target]] for target, sent in moving)
    assert armed.state.missed == 0


def test_path_end_ramps_to_zero_and_off(armed: Bench) -> None:
    armed.run(30)
    armed.play()
    armed.until(Mode.ACTIVE)
    armed.until(Mode.OFF)
    assert armed.alarms[-1].code == "Finished"
    assert armed.state.places == ()
    assert armed.offsets == (0, 0)
    count = len(armed.frames)
    armed.run(50)
    assert len(armed.frames) == count


def test_the_last_row_is_sent_and_the_ramp_begins_behind_it(armed: Bench) -> None:
    path = armed.path
    assert path is not None
    demand, offset = (tuple(column[:200] for column in columns) for columns in (path.demand, path.offset))
    assert offset[0][-1] > offset[0][-2]
    armed.path = CorrectedPath(0, demand, offset, True, DIGEST, 1)
    armed.run(30)
    armed.play()
    armed.until(Mode.RAMP_DOWN)
    sent = {tick: offsets[0] for tick, offsets in armed.frames}
    assert sent[armed.tick - 1] == offset[0][-1]
    assert sent[armed.tick] != offset[0][-1]
    assert armed.drives[0].target == demand[0][-1]


def test_what_ended_it_is_told_once_and_by_its_own_name(armed: Bench) -> None:
    for kind, code in (("stop", "Stopped"), ("disarm", "Disarmed")):
        machine = copy.deepcopy(armed)
        result = [machine.sync().transition for _ in range(5)]
        assert result == [None] * 5
        assert machine.sync(Request("stop" if kind == "stop" else "disarm")).transition == (
            *(Mode.ARMED, Mode.RAMP_DOWN),
            Alarm(code),
        )
        machine.until(Mode.OFF)
        assert machine.state.cause == Alarm(code)
        assert machine.state.places == ()
        assert machine.arm() == ()
        assert machine.state.cause is None


def test_each_landing_sends_its_own_zeros(armed: Bench) -> None:
    for _ in range(2):
        armed.run(25)
        before = len(armed.frames)
        armed.sync(Request("disarm"))
        armed.until(Mode.OFF)
        assert len(armed.frames) - before == ZEROS + 1
        armed.settle(5)
        assert armed.arm() == ()


def test_how_far_it_has_settled_is_told() -> None:
    machine = bench()
    machine.settle(30)
    machine.drives[0].mode = 1
    machine.settle(11)
    machine.drives[0].mode = 8
    while machine.state.good_for == 0:
        machine.sync()
    machine.run(9)
    (refused,) = machine.arm()
    assert refused == Alarm("NotSettled", detail="11 so far")


def test_the_first_withdrawn_fact_is_the_cause(armed: Bench) -> None:
    axes, bus = armed.listener.at_sync(bytes([armed.counter + 1]), (armed.tick + 1) * 1e-3, (armed.tick + 1) * 1e-3)
    withdrawn = (Alarm("ModelStale"), Alarm("PoorSkill"))
    armed.step(Inputs(True, axes, bus, withdrawn=withdrawn, path=armed.path))
    assert (armed.mode, armed.state.cause) == (Mode.RAMP_DOWN, Alarm("ModelStale"))


@pytest.mark.fault("E18")
def test_disarm_in_the_cut_is_a_ramp(armed: Bench) -> None:
    armed.run(30)
    armed.play()
    armed.until(Mode.ACTIVE)
    armed.run(250)
    start = armed.offsets[0]
    assert start > 200
    armed.sync(Request("disarm"))
    assert armed.mode is Mode.RAMP_DOWN
    taken = 1
    while armed.offsets != (0, 0):
        armed.sync()
        taken += 1
    assert taken <= ramp_cycles(armed.settings.axes[0].limits, start)
    armed.until(Mode.OFF)
    assert armed.alarms[-1].code == "Disarmed"
