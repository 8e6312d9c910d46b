"""Details of the core that no single fault reaches."""

from __future__ import annotations

import pytest

from fdhil.guard import guard_step, offset_limits
from fdhil.guard.corrected_path import CorrectedPath, compute_path_rate
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardRequest, StepInputs
from fdhil.guard.interlock_checks import get_confirmed_read_back
from fdhil.guard.interlocks import Alarm
from fdhil.guard.read_back_checks import observe_drives
from tests.guard.simulated_bus import Bench, bench


def active() -> Bench:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    machine.run_until(Mode.ACTIVE)
    machine.run(150)
    return machine


def inputs_of(machine: Bench, withdrawn: tuple[Alarm, ...] = ()) -> StepInputs:
    machine.counter = machine.counter % 240 + 1
    seen, bus = machine.listener.receive_at_sync(bytes([machine.counter]), 0.0, 0.0)
    return StepInputs(True, seen, bus, path=machine.path, withdrawn=withdrawn)


def test_withdrawn_fact_ramps_down() -> None:
    machine = active()
    machine.decide_and_check(inputs_of(machine, (Alarm("ModelStale"),)))
    assert machine.state.mode is Mode.RAMP_DOWN
    assert machine.alarms[-1].code == "ModelStale"


def test_status_lists_failing_interlocks() -> None:
    machine = bench()
    machine.settle()
    assert guard_step.list_status_alarms(machine.state, inputs_of(machine), machine.settings) == ()
    machine.drives[0].mode = 1
    machine.settle(20)
    result = guard_step.list_status_alarms(machine.state, inputs_of(machine), machine.settings)
    assert ("NotCsp", "X") in {(alarm.code, alarm.axis) for alarm in result}


def test_adopt_is_granted_only_in_off_and_frozen() -> None:
    machine = active()
    refused = machine.run_sync(GuardRequest("adopt", token_valid=True)).refused
    assert refused is not None
    assert "NotOff" in {alarm.code for alarm in refused}
    assert machine.state.mode is Mode.ACTIVE


def test_arm_refusal_in_frozen_advises_adopt() -> None:
    machine = active()
    machine.listener.set_controller_state("off")
    machine.run_until(Mode.FROZEN)
    result = next(alarm for alarm in machine.arm() if alarm.code == "NotOff")
    assert "adopt" in result.action
    assert "armed or ramping" not in result.cause


def test_adoption_waits_for_the_read_back() -> None:
    machine = active()
    machine.listener.set_controller_state("off")
    machine.run_sync()
    machine.listener.set_controller_state("active")
    for drive in machine.drives:
        drive.answers = False
    machine.run(12)
    refused = machine.run_sync(GuardRequest("adopt", token_valid=True)).refused
    assert refused is not None
    assert "StaleData" in {alarm.code for alarm in refused}


def test_reboot_during_a_ramp_down_freezes() -> None:
    machine = active()
    machine.run_sync(GuardRequest("disarm"))
    machine.receive_frames(0x701, b"\x00")
    machine.run_sync()
    assert machine.state.mode is Mode.FROZEN


def test_start_is_not_found_before_the_targets_stood_still() -> None:
    machine = bench()
    assert machine.path is not None
    creeping = [[machine.path.demand[0][0] + step, machine.path.demand[1][0]] for step in (0, 1)]
    for k in range(400):  # near the path's begin: a rapid that is about to end
        machine.rest = creeping[k % 2]
        if k == 200:
            assert machine.arm() == ()
        else:
            machine.run_sync()
    assert machine.mode is Mode.ARMED


def test_path_that_starts_right_after_arming_is_recognised() -> None:
    machine = bench()
    assert machine.path is not None
    machine.row = machine.path.count_standing_rows() - 1  # the targets have stood there for long, before the arming too
    machine.settle()
    machine.play()
    assert machine.arm() == ()
    machine.run_until(Mode.ACTIVE, 300)
    machine.run_until(Mode.OFF)
    assert machine.alarms[-1].code == "Finished"
    assert machine.state.missed == 0


def test_lost_target_at_standstill_is_not_a_start() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    machine.run(20)
    machine.run_sync(nc=False)
    machine.stream()
    machine.run(50)
    assert machine.mode is Mode.ARMED
    machine.play()
    machine.run_until(Mode.ACTIVE, 300)


def test_heartbeat_is_sent_only_with_offsets() -> None:
    machine = active()
    machine.run(300)
    for output in machine.outputs:
        assert not output.heartbeat or output.offsets is not None


def test_row_outside_the_table_gets_the_nearest_end() -> None:
    path = CorrectedPath(5, ([0, 10, 20],), ([1, 2, 3],), True, "p")
    assert path.measure_row_distance(4, (0,)) is None
    assert path.measure_row_distance(8, (0,)) is None
    assert path.get_row_offsets(0) == (1,)
    assert path.get_row_offsets(99) == (3,)
    assert path.count_standing_rows() == 5
    assert compute_path_rate(path, 6, (0,), (5,)) == 0.5
    assert compute_path_rate(path, 6, (0,), (500,)) is None
    assert compute_path_rate(path, 6, (-9,), (5,)) is None
    resting = CorrectedPath(0, ([7, 7, 7],), ([0, 0, 0],), True, "p")
    assert resting.count_standing_rows() == 2
    assert compute_path_rate(resting, 1, (7,), (7,)) is None


@pytest.mark.parametrize("wrong", [10**6, -(10**6), 1.5, None])
def test_invalid_frame_is_stopped_by_the_check(monkeypatch: pytest.MonkeyPatch, wrong: object) -> None:
    machine = active()
    machine.run_sync(GuardRequest("disarm"))
    count = len(machine.frames)
    monkeypatch.setattr(guard_step, offset_limits.move_toward_goal.__name__, lambda *_: wrong)
    machine.run_sync()
    assert machine.state.mode is Mode.FROZEN
    assert machine.alarms[-1].code == "InternalError"
    assert len(machine.frames) == count


def test_ramp_down_ends_with_zeros_that_were_read_back() -> None:
    machine = active()
    machine.run_sync(GuardRequest("disarm"))
    machine.run_until(Mode.OFF)
    sent = [offsets for _, offsets in machine.frames]
    zeros = next(k for k, offsets in enumerate(reversed(sent)) if offsets != (0, 0))
    assert 4 <= zeros <= 4 + 12
    resting = bench()
    resting.settle()
    resting.arm()
    resting.run(25)
    count = len(resting.frames)
    resting.run_sync(GuardRequest("disarm"))
    resting.run_until(Mode.OFF)
    assert len(resting.frames) - count == 4  # zeros were read back before: three more, and the one that ends it


def test_fifty_unconfirmed_zeros_freeze() -> None:
    machine = active()
    machine.run_sync(GuardRequest("disarm"))
    for drive in machine.drives:
        drive.answers = False
    machine.run_until(Mode.FROZEN)
    sent = [offsets for _, offsets in machine.frames]
    zeros = next(k for k, offsets in enumerate(reversed(sent)) if offsets != (0, 0))
    assert zeros == 52  # the first of them came in motion
    assert machine.state.cause == Alarm("EchoMismatch", detail="no zero was read back")


def test_one_zero_reading_confirms_a_ramp_down() -> None:
    machine = active()
    machine.run_sync(GuardRequest("disarm"))
    machine.run_until(Mode.OFF)
    assert [get_confirmed_read_back(axis) for axis in machine.state.axes] == [0, 0]


def test_unsent_frame_keeps_the_previous_offset() -> None:
    machine = active()
    before = machine.state.axes[0]
    machine.run_sync()
    seen = inputs_of(machine)._replace(unsent=(0, 1))
    after = observe_drives(machine.state, seen, machine.settings)
    assert after.axes[0].offset == before.offset
    assert after.axes[0].rate == 0
    assert after.axes[0].sent[:3] == (before.offset, before.offset, before.sent[1])
    assert after.failed_run == 1
    assert after.mode is Mode.RAMPING


def test_each_hold_lasts_ten_cycles() -> None:
    machine = active()
    for _ in range(3):
        for _ in range(10):  # the first of them still latches what was streamed before
            machine.run_sync(nc=False)
            machine.row += 1
        machine.run_sync()
        assert machine.state.mode is Mode.HOLD
        assert machine.state.cause == Alarm("TargetLost", "X")
        machine.run_until(Mode.ACTIVE, 20)
        assert machine.state.cause is None
    for _ in range(11):
        machine.run_sync(nc=False)
        machine.row += 1
    assert machine.state.mode is Mode.HOLD
    assert machine.run_until(Mode.RAMP_DOWN) == 1
    assert machine.alarms[-1].code == "TargetLost"


def test_one_good_cycle_between_two_gaps_resets_the_hold() -> None:
    """Gaps do not add up: each may last as long as a single one."""
    machine = active()
    for _ in range(4):
        for _ in range(10):  # the first of them latches what was streamed before: it is the good one
            machine.run_sync(nc=False)
            machine.row += 1
        machine.run_sync()
        assert machine.mode is Mode.HOLD
    machine.run_until(Mode.ACTIVE, 20)
    assert {alarm.code for alarm in machine.alarms} == {"TargetLost"}


def test_gap_before_the_start_ends_the_correction_after_ten_cycles() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    for _ in range(2):
        for _ in range(10):  # the first of them still latches what was streamed before
            machine.run_sync(nc=False)
        machine.run_sync()
        machine.run(2)
        assert machine.mode is Mode.ARMED
    for _ in range(11):
        machine.run_sync(nc=False)
    assert machine.mode is Mode.ARMED
    assert machine.run_until(Mode.RAMP_DOWN) == 1
    assert machine.alarms[-1].code == "TargetLost"
    assert {offsets for _, offsets in machine.frames} == {(0, 0)}


def test_time_advances_without_sync_only_for_event_driven_offsets() -> None:
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


def test_event_driven_offset_waits_for_sync_while_sync_runs() -> None:
    machine = bench(offset_synchronous=False)
    machine.settle()
    assert machine.arm() == ()
    seen, bus = machine.listener.read_between_syncs(0.0, silent=False)
    assert machine.decide_and_check(StepInputs(False, seen, bus, path=machine.path)).offsets is None


def test_following_error_reported_by_the_drive_is_used() -> None:
    machine = bench()
    seen = inputs_of(machine)
    axes = tuple([axis._replace(following_error=-70) for axis in seen.axes])
    state = observe_drives(machine.state, seen._replace(axes=axes), machine.settings)
    assert [axis.following_error for axis in state.axes] == [-70, -70]
