"""Details of the core that no single fault reaches."""

from __future__ import annotations

import pytest

from fdhil.guard import core, limits
from fdhil.guard.conditions import known
from fdhil.guard.interlocks import Alarm
from fdhil.guard.path import CorrectedPath, rate_between
from fdhil.guard.plausibility import observe
from fdhil.guard.protocol import Mode
from fdhil.guard.state import Inputs, Request
from tests.guard.machine import Bench, bench


def active() -> Bench:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    machine.until(Mode.ACTIVE)
    machine.run(150)
    return machine


def inputs_of(machine: Bench, withdrawn: tuple[Alarm, ...] = ()) -> Inputs:
    machine.counter = machine.counter % 240 + 1
    seen, bus = machine.listener.at_sync(bytes([machine.counter]), 0.0, 0.0)
    return Inputs(True, seen, bus, path=machine.path, withdrawn=withdrawn)


def test_what_the_daemon_withdraws_ramps_down() -> None:
    machine = active()
    machine.step(inputs_of(machine, (Alarm("ModelStale"),)))
    assert machine.state.mode is Mode.RAMP_DOWN
    assert machine.alarms[-1].code == "ModelStale"


def test_status_tells_what_is_not_good() -> None:
    machine = bench()
    machine.settle()
    assert core.standing(machine.state, inputs_of(machine), machine.settings) == ()
    machine.drives[0].mode = 1
    machine.settle(20)
    result = core.standing(machine.state, inputs_of(machine), machine.settings)
    assert ("NotCsp", "X") in {(alarm.code, alarm.axis) for alarm in result}


def test_adopting_is_for_off_and_frozen_alone() -> None:
    machine = active()
    refused = machine.sync(Request("adopt", token_valid=True)).refused
    assert refused is not None
    assert "NotOff" in {alarm.code for alarm in refused}
    assert machine.state.mode is Mode.ACTIVE


def test_who_arms_in_frozen_is_told_to_adopt_and_not_to_disarm() -> None:
    machine = active()
    machine.listener.error("off")
    machine.until(Mode.FROZEN)
    result = next(alarm for alarm in machine.arm() if alarm.code == "NotOff")
    assert "adopt" in result.action
    assert "armed or ramping" not in result.cause


def test_adopting_waits_for_the_drives_own_word() -> None:
    machine = active()
    machine.listener.error("off")
    machine.sync()
    machine.listener.error("active")
    for drive in machine.drives:
        drive.answers = False
    machine.run(12)
    refused = machine.sync(Request("adopt", token_valid=True)).refused
    assert refused is not None
    assert "StaleData" in {alarm.code for alarm in refused}


def test_a_reboot_while_ramping_down_freezes() -> None:
    machine = active()
    machine.sync(Request("disarm"))
    machine.hear(0x701, b"\x00")
    machine.sync()
    assert machine.state.mode is Mode.FROZEN


def test_the_start_is_not_found_before_the_targets_have_stood() -> None:
    machine = bench()
    assert machine.path is not None
    creeping = [[machine.path.demand[0][0] + step, machine.path.demand[1][0]] for step in (0, 1)]
    for k in range(400):  # near the path's begin: a rapid that is about to end
        machine.rest = creeping[k % 2]
        if k == 200:
            assert machine.arm() == ()
        else:
            machine.sync()
    assert machine.mode is Mode.ARMED


def test_a_path_that_starts_right_after_arming_is_recognised() -> None:
    machine = bench()
    assert machine.path is not None
    machine.row = machine.path.standing_rows() - 1  # the targets have stood there for long, before the arming too
    machine.settle()
    machine.play()
    assert machine.arm() == ()
    machine.until(Mode.ACTIVE, 300)
    machine.until(Mode.OFF)
    assert machine.alarms[-1].code == "Finished"
    assert machine.state.missed == 0


def test_a_lost_target_at_rest_is_no_start() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    machine.run(20)
    machine.sync(nc=False)
    machine.stream()
    machine.run(50)
    assert machine.mode is Mode.ARMED
    machine.play()
    machine.until(Mode.ACTIVE, 300)


def test_heartbeat_alone_never_leaves() -> None:
    machine = active()
    machine.run(300)
    for output in machine.outputs:
        assert not output.heartbeat or output.offsets is not None


def test_rows_outside_the_table() -> None:
    path = CorrectedPath(5, ([0, 10, 20],), ([1, 2, 3],), True, "p")
    assert path.mismatch(4, (0,)) is None
    assert path.mismatch(8, (0,)) is None
    assert path.offsets_at(0) == (1,)
    assert path.offsets_at(99) == (3,)
    assert path.standing_rows() == 5
    assert rate_between(path, 6, (0,), (5,)) == 0.5
    assert rate_between(path, 6, (0,), (500,)) is None
    assert rate_between(path, 6, (-9,), (5,)) is None
    resting = CorrectedPath(0, ([7, 7, 7],), ([0, 0, 0],), True, "p")
    assert resting.standing_rows() == 2
    assert rate_between(resting, 1, (7,), (7,)) is None


@pytest.mark.parametrize("wrong", [10**6, -(10**6), 1.5, None])
def test_a_wrong_frame_is_caught_whatever_made_it(monkeypatch: pytest.MonkeyPatch, wrong: object) -> None:
    machine = active()
    machine.sync(Request("disarm"))
    count = len(machine.frames)
    monkeypatch.setattr(core, limits.follow.__name__, lambda *_: wrong)
    machine.sync()
    assert machine.state.mode is Mode.FROZEN
    assert machine.alarms[-1].code == "InternalError"
    assert len(machine.frames) == count


def test_a_landing_ends_with_zeros_that_were_read_back() -> None:
    machine = active()
    machine.sync(Request("disarm"))
    machine.until(Mode.OFF)
    sent = [offsets for _, offsets in machine.frames]
    zeros = next(k for k, offsets in enumerate(reversed(sent)) if offsets != (0, 0))
    assert 4 <= zeros <= 4 + 12
    resting = bench()
    resting.settle()
    resting.arm()
    resting.run(25)
    count = len(resting.frames)
    resting.sync(Request("disarm"))
    resting.until(Mode.OFF)
    assert len(resting.frames) - count == 4  # zeros were read back before: three more, and the one that ends it


def test_unconfirmed_zeros_freeze_after_fifty() -> None:
    machine = active()
    machine.sync(Request("disarm"))
    for drive in machine.drives:
        drive.answers = False
    machine.until(Mode.FROZEN)
    sent = [offsets for _, offsets in machine.frames]
    zeros = next(k for k, offsets in enumerate(reversed(sent)) if offsets != (0, 0))
    assert zeros == 52  # the first of them came in motion
    assert machine.state.cause == Alarm("EchoMismatch", detail="no zero was read back")


def test_a_landing_that_one_reading_confirmed_is_known_to_be_at_zero() -> None:
    machine = active()
    machine.sync(Request("disarm"))
    machine.until(Mode.OFF)
    assert [known(axis) for axis in machine.state.axes] == [0, 0]


def test_a_frame_that_did_not_leave_changes_nothing() -> None:
    machine = active()
    before = machine.state.axes[0]
    machine.sync()
    seen = inputs_of(machine)._replace(unsent=(0, 1))
    after = observe(machine.state, seen, machine.settings)
    assert after.axes[0].offset == before.offset
    assert after.axes[0].rate == 0
    assert after.axes[0].sent[:3] == (before.offset, before.offset, before.sent[1])
    assert after.failed_run == 1
    assert after.mode is Mode.RAMPING


def test_a_hold_lasts_ten_cycles_each_time_anew() -> None:
    machine = active()
    for _ in range(3):
        for _ in range(10):  # the first of them still latches what was streamed before
            machine.sync(nc=False)
            machine.row += 1
        machine.sync()
        assert machine.state.mode is Mode.HOLD
        assert machine.state.cause == Alarm("TargetLost", "X")
        machine.until(Mode.ACTIVE, 20)
        assert machine.state.cause is None
    for _ in range(11):
        machine.sync(nc=False)
        machine.row += 1
    assert machine.state.mode is Mode.HOLD
    assert machine.until(Mode.RAMP_DOWN) == 1
    assert machine.alarms[-1].code == "TargetLost"


def test_one_good_cycle_between_two_gaps_is_enough() -> None:
    """Gaps do not add up: each may last as long as a single one."""
    machine = active()
    for _ in range(4):
        for _ in range(10):  # the first of them latches what was streamed before: it is the good one
            machine.sync(nc=False)
            machine.row += 1
        machine.sync()
        assert machine.mode is Mode.HOLD
    machine.until(Mode.ACTIVE, 20)
    assert {alarm.code for alarm in machine.alarms} == {"TargetLost"}


def test_a_gap_before_the_start_holds_nothing_and_ends_after_ten_cycles() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    for _ in range(2):
        for _ in range(10):  # the first of them still latches what was streamed before
            machine.sync(nc=False)
        machine.sync()
        machine.run(2)
        assert machine.mode is Mode.ARMED
    for _ in range(11):
        machine.sync(nc=False)
    assert machine.mode is Mode.ARMED
    assert machine.until(Mode.RAMP_DOWN) == 1
    assert machine.alarms[-1].code == "TargetLost"
    assert {offsets for _, offsets in machine.frames} == {(0, 0)}


def test_time_goes_on_without_sync_only_where_it_can_be_ramped() -> None:
    machine = active()
    tick = machine.state.tick
    machine.silence()
    assert machine.state.tick == tick
    machine = bench(offset_synchronous=False)
    machine.settle()
    machine.arm()
    machine.run(30)
    tick = machine.state.tick
    machine.silence()
    machine.silence()
    assert machine.state.tick == tick + 2


def test_an_event_driven_offset_waits_for_the_next_sync_while_there_is_any() -> None:
    machine = bench(offset_synchronous=False)
    machine.settle()
    assert machine.arm() == ()
    seen, bus = machine.listener.in_silence(0.0, silent=False)
    assert machine.step(Inputs(False, seen, bus, path=machine.path)).offsets is None


def test_a_following_error_that_the_drive_tells_is_taken_as_it_is() -> None:
    machine = bench()
    seen = inputs_of(machine)
    axes = tuple([axis._replace(following_error=-70) for axis in seen.axes])
    state = observe(machine.state, seen._replace(axes=axes), machine.settings)
    assert [axis.following_error for axis in state.axes] == [-70, -70]
