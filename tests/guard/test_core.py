"""The guard's life of one correction, on the frames that leave."""

from __future__ import annotations

import pytest

from fdhil.guard.protocol import Mode
from fdhil.guard.state import Request
from tests.guard.machine import Bench, bench, ramp_cycles


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
    assert armed.offsets == (0, 0)
    count = len(armed.frames)
    armed.run(50)
    assert len(armed.frames) == count


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
