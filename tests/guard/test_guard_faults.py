"""Each fault during a cut: its class once, the reaction of the fault matrix, zero within the time to safe."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from dataclasses import replace

import pytest

from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.guard_protocol import ON_PATH, Mode
from fdhil.guard.guard_state import GuardRequest
from fdhil.guard.interlocks import Alarm
from fdhil.guard.offset_limits import OffsetLimits
from tests.guard.simulated_bus import DIGEST, RECORD, Bench, Drive, bench, ramp_cycles

Fault = Callable[[Bench], None]
Tell = Callable[[str, object], None]


def _drive(**changes: object) -> Fault:
    def apply(machine: Bench) -> None:
        for name, value in changes.items():
            setattr(machine.drives[0], name, value)

    return apply


def _receive_frame(cob_id: int, data: bytes) -> Fault:
    return lambda machine: machine.receive_frames(cob_id, data)


def _set(**changes: object) -> Fault:
    def apply(machine: Bench) -> None:
        for name, value in changes.items():
            setattr(machine, name, value)

    return apply


def _shift(machine: Bench) -> None:
    machine.row += 3


def _hold(machine: Bench) -> None:
    machine.playing = False


def _bus(state: str) -> Fault:
    return lambda machine: machine.listener.set_controller_state(state)


def _lose(machine: Bench) -> None:
    machine.listener.lost_frames += 1


def _short(machine: Bench) -> None:
    for _ in range(3):
        machine.receive_frames(0x181, b"\0")


def _counter(step: int) -> Fault:
    def apply(machine: Bench) -> None:
        machine.counter += step

    return apply


RAMPED: dict[str, tuple[Fault, str, int]] = {
    # row of the fault matrix: what happens, class, SYNC until it is detected
    "A2": (_bus("passive"), "ErrorPassive", 1),
    "A6": (_lose, "RxOverflow", 1),
    "A9": (_counter(100), "SyncCollision", 1),
    "A10": (_drive(answers=False), "StaleData", 5),
    "A15": (_short, "PdoLength", 1),
    "A20": (_receive_frame(0x081, b"\x30\x81"), "DriveEmergency", 1),
    "A20 short": (_receive_frame(0x081, b"\x30"), "DriveEmergency", 1),
    "E6": (_shift, "Misaligned", 12),
    "E9": (_drive(mode=1), "NotCsp", 12),
    "E10": (_drive(statusword=0x0250), "DriveNotEnabled", 2),
    "E11": (_drive(statusword=0x1A37), "LimitActive", 2),
    "E12 bit": (_drive(statusword=0x3237), "FollowingError", 2),
    "E12 error": (_drive(position_error=16500), "FollowingError", 2),
    "E12 negative": (_drive(position_error=-16500), "FollowingError", 2),
    "E15 ignored": (_drive(scale=0.0), "EchoMismatch", 22),
    "E15 scaled": (_drive(scale=0.5), "EchoMismatch", 22),
    "F8": (_receive_frame(0x764, b"\x05"), "BusLocked", 1),
    "F15": (_set(main_alive=False), "MainLost", 1),
}
FROZEN: dict[str, tuple[Fault, str]] = {
    "A1": (_bus("off"), "BusOff"),
    "A3": (_bus("restarted"), "BusRestarted"),
    "A4": (_bus("down"), "BusDown"),
    "A24 NMT": (_receive_frame(0x000, b"\x80\x00"), "NmtStateWrong"),
    "A24 heartbeat": (_receive_frame(0x701, b"\x04"), "NmtStateWrong"),
}


@pytest.fixture(scope="module")
def active_machine() -> Bench:
    machine = bench(amplitude=800)
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    while machine.offsets[0] < 600:
        machine.run_sync()
    assert machine.mode is Mode.ACTIVE
    machine.alarms.clear()
    return machine


@pytest.fixture
def cutting_machine(active_machine: Bench) -> Bench:
    return copy.deepcopy(active_machine)


@pytest.mark.parametrize("row", RAMPED)
@pytest.mark.fault("A2", "A6", "A9", "A10", "A15", "A20", "E6", "E9", "E10", "E11", "E12", "E15", "F8", "F15")
def test_fault_ramps_down_in_time(cutting_machine: Bench, row: str, record_property: Tell) -> None:
    fault, code, detected = RAMPED[row]
    limits, since = cutting_machine.settings.axes[0].limits, cutting_machine.tick
    fault(cutting_machine)
    for _ in range(detected):
        assert cutting_machine.mode in ON_PATH
        cutting_machine.run_sync()
        if cutting_machine.mode is Mode.RAMP_DOWN:
            break
    assert cutting_machine.mode is Mode.RAMP_DOWN
    peak = max(map(abs, cutting_machine.offsets))
    taken, rising = 1, -(-limits.hard_rate // limits.acceleration)
    while cutting_machine.offsets != (0, 0):
        before = max(map(abs, cutting_machine.offsets))
        cutting_machine.run_sync()
        taken += 1
        assert taken <= rising or max(map(abs, cutting_machine.offsets)) <= before
    assert taken <= ramp_cycles(limits, peak)
    record_property("sync_to_zero", cutting_machine.to_zero(since))
    cutting_machine.drives = [Drive(d.node_id, queue=d.queue, offset=d.offset) for d in cutting_machine.drives]
    cutting_machine.run_until(Mode.OFF)
    assert cutting_machine.state.cause is not None
    assert cutting_machine.state.cause.code == code
    assert [alarm.code for alarm in cutting_machine.alarms if alarm.reaction > 1].count(code) <= 2
    assert {alarm.code for alarm in cutting_machine.alarms} <= {code, "FeedbackGap"}


@pytest.mark.parametrize("row", FROZEN)
@pytest.mark.fault("A1", "A3", "A4", "A24")
def test_fault_freezes_at_once_until_the_operator_adopts(cutting_machine: Bench, row: str) -> None:
    fault, code = FROZEN[row]
    count, held = len(cutting_machine.frames), cutting_machine.offsets
    fault(cutting_machine)
    cutting_machine.run(30)
    assert cutting_machine.mode is Mode.FROZEN
    assert [alarm.code for alarm in cutting_machine.alarms] == [code]
    assert len(cutting_machine.frames) == count
    cutting_machine.listener.set_controller_state("active")
    cutting_machine.receive_frames(0x701, b"\x05")
    cutting_machine.run(30)
    assert cutting_machine.mode is Mode.FROZEN
    assert cutting_machine.run_sync(GuardRequest("adopt")).refused != ()
    assert cutting_machine.run_sync(GuardRequest("adopt", token_valid=True)).refused == ()
    assert abs(cutting_machine.frames[count][1][0] - held[0]) <= cutting_machine.settings.axes[0].limits.rate
    cutting_machine.run_until(Mode.OFF)
    assert cutting_machine.drives[0].offset == 0


@pytest.mark.fault("A23")
def test_reboot_freezes_until_the_drive_is_compared_and_adopted(cutting_machine: Bench) -> None:
    count = len(cutting_machine.frames)
    cutting_machine.reboot(0)
    cutting_machine.run(30)
    cutting_machine.receive_frames(0x701, b"\x05")
    cutting_machine.run(30)
    assert cutting_machine.mode is Mode.FROZEN
    assert [alarm.code for alarm in cutting_machine.alarms] == ["NodeRebooted"]
    assert len(cutting_machine.frames) == count
    adopt = GuardRequest("adopt", token_valid=True)
    assert cutting_machine.run_sync(adopt).refused == (Alarm("RecordVoid", "X"),)
    assert (
        cutting_machine.run_sync(GuardRequest("compared", True, compared={"X": RECORD}, touched={"X": 1})).refused == ()
    )
    assert cutting_machine.run_sync(adopt).refused == ()
    cutting_machine.run_until(Mode.OFF)
    assert [drive.offset for drive in cutting_machine.drives] == [0, 0]


@pytest.mark.fault("A7")
def test_sync_loss_freezes_a_synchronous_offset(cutting_machine: Bench) -> None:
    cutting_machine.silence()
    assert cutting_machine.mode is Mode.FROZEN
    assert [alarm.code for alarm in cutting_machine.alarms] == ["SyncLost"]


@pytest.mark.fault("A7")
def test_sync_loss_ramps_down_an_event_driven_offset(record_property: Tell) -> None:
    machine = bench(offset_synchronous=False)
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    while machine.offsets[0] < 200:
        machine.run_sync()
    count = len(machine.frames)
    for _ in range(60):
        machine.silence()
    ramp = [any(offsets) for _, offsets in machine.frames[count:]]
    record_property("sync_to_zero", 1 + ramp.index(False))  # the steps of the local timer, one a period
    assert machine.state.cause is not None
    assert machine.state.cause.code == "SyncLost"
    assert machine.offsets == (0, 0)
    assert len(machine.frames) > count + 5
    assert machine.heartbeats[-1] == machine.tick


def test_sync_loss_at_zero_offset_goes_off() -> None:
    machine = bench()
    machine.settle()
    machine.arm()
    machine.silence()
    assert machine.mode is Mode.OFF
    assert [alarm.code for alarm in machine.alarms] == ["SyncLost"]


@pytest.mark.parametrize("lost", [1, 2, 9])
def test_lost_targets_are_bridged_and_the_path_is_found_again(cutting_machine: Bench, lost: int) -> None:
    for _ in range(lost):
        cutting_machine.run_sync(nc=False)
        cutting_machine.row += 1  # the NC went on, its frames did not come through
    cutting_machine.run_sync()
    assert cutting_machine.mode is Mode.HOLD
    cutting_machine.run(20 + lost)
    assert cutting_machine.state.mode is Mode.ACTIVE


@pytest.mark.fault("A10")
def test_lost_feedback_is_bridged(cutting_machine: Bench) -> None:
    cutting_machine.run_sync(drop=(0x281,))
    cutting_machine.run_sync()
    assert cutting_machine.mode is Mode.HOLD
    cutting_machine.run(10)
    assert cutting_machine.state.mode is Mode.ACTIVE


@pytest.mark.fault("E17")
def test_feed_hold_keeps_the_offset_and_the_correction_continues(cutting_machine: Bench) -> None:
    _hold(cutting_machine)
    cutting_machine.run(12)
    assert cutting_machine.mode is Mode.HOLD
    assert cutting_machine.state.cause is not None
    assert cutting_machine.state.cause.code == "FeedHold"
    held = cutting_machine.offsets
    cutting_machine.run(500)
    assert cutting_machine.offsets == held
    cutting_machine.play()
    cutting_machine.run_until(Mode.ACTIVE, 40)


@pytest.mark.fault("E17")
def test_long_feed_hold_ends_the_correction() -> None:
    cutting = bench(sync_period_s=0.02)
    cutting.settle()
    cutting.arm()
    cutting.run(30)
    cutting.play()
    cutting.run(250)
    _hold(cutting)
    cutting.run(490)
    assert cutting.mode is Mode.HOLD
    cutting.run(30)
    cutting.run_until(Mode.OFF)
    assert cutting.alarms[-1].code == "FeedHold"


@pytest.mark.parametrize("late", [1, 3, 10])
def test_missed_cycles_are_counted_and_caught_up(cutting_machine: Bench, late: int) -> None:
    for _ in range(late):
        sent = [axis.sent for axis in cutting_machine.state.axes]
        assert cutting_machine.run_sync(late=True).offsets is None
        assert [axis.sent for axis in cutting_machine.state.axes] == [(last[0], *last[:-1]) for last in sent]
    cutting_machine.run(25)
    assert cutting_machine.mode is Mode.ACTIVE
    assert cutting_machine.state.missed == late


def test_many_missed_cycles_ramp_down(cutting_machine: Bench) -> None:
    for _ in range(11):
        cutting_machine.run_sync(late=True)
    cutting_machine.run_until(Mode.OFF)
    assert cutting_machine.alarms[-1].code == "LoopOverrun"


def test_simulated_machine_ahead_of_an_idle_guard_is_no_overrun() -> None:
    machine = bench()
    machine.settle()
    for _ in range(300):
        machine.run_sync(late=True)
    assert (machine.state.missed_run, machine.state.good_for > 300) == (0, True)
    machine.arm()
    for _ in range(300):
        machine.run_sync(late=True)
    machine.run(30)
    machine.play()
    machine.run_until(Mode.ACTIVE)


def test_late_loop_on_a_real_machine_prevents_arming() -> None:
    machine = bench(clock="monotonic")
    machine.settle()
    for _ in range(11):
        machine.run_sync(late=True)
    assert (machine.state.missed_run, machine.state.good_for) == (11, 0)


@pytest.mark.parametrize(
    ("failures", "mode"), [(1, Mode.ACTIVE), (2, Mode.ACTIVE), (3, Mode.OFF), (5, Mode.OFF), (6, Mode.FROZEN)]
)
@pytest.mark.fault("A5")
def test_full_transmit_queue_ramps_down(cutting_machine: Bench, failures: int, mode: Mode) -> None:
    for _ in range(failures):
        cutting_machine.run_sync(unsent=(0, 1))
    cutting_machine.run(80)
    assert cutting_machine.mode is mode
    assert {alarm.code for alarm in cutting_machine.alarms if alarm.reaction > 1} <= {"TxQueueFull"}
    assert bool(cutting_machine.alarms) is (mode is not Mode.ACTIVE)


def test_late_read_back_is_counted_and_tolerated(cutting_machine: Bench) -> None:
    for _ in range(60):
        for drive in cutting_machine.drives:  # the drive latches what was sent a cycle earlier
            drive.received_offset = cutting_machine.frames[-2][1][drive.node_id - 1]
        cutting_machine.run_sync()
    assert cutting_machine.mode is Mode.ACTIVE
    assert cutting_machine.state.axes[0].late_echoes >= 5


@pytest.mark.fault("E13")
def test_guard_adopts_the_offset_of_a_drive_at_start() -> None:
    machine = bench()
    machine.drives[1].hold(-500)
    machine.run_until(Mode.ADOPT)
    assert abs(machine.frames[0][1][1] + 500) <= machine.settings.axes[1].limits.acceleration
    machine.run_until(Mode.OFF)
    assert machine.drives[1].offset == 0
    machine.drives[1].received_offset = 77
    machine.run(200)
    assert machine.mode is Mode.OFF  # only at the start: later it is another's, and nothing is armed over it
    assert "StaleOffset" in {alarm.code for alarm in machine.arm()}


def test_guard_freezes_when_the_drive_keeps_its_offset(cutting_machine: Bench) -> None:
    cutting_machine.run_sync(GuardRequest("disarm"))
    cutting_machine.run(5)
    cutting_machine.drives[0].answers = False
    cutting_machine.run(200)
    assert cutting_machine.mode is Mode.FROZEN
    assert cutting_machine.state.cause is not None
    assert cutting_machine.state.cause.code == "EchoMismatch"


def test_first_move_off_the_path_ends_the_correction() -> None:
    machine = bench()
    machine.settle()
    machine.arm()
    machine.run(30)
    machine.rest = [7, 900]
    machine.run(3)
    assert machine.mode in (Mode.RAMP_DOWN, Mode.OFF)
    machine.run_until(Mode.OFF)
    assert machine.alarms[-1].code == "Misaligned"


@pytest.mark.parametrize(("row", "value", "code"), [(300, 240, "OffsetRate"), (300, 5000, "OffsetLimit")])
@pytest.mark.fault("E1", "E2")
def test_table_that_breaks_a_limit_at_run_time_ramps_down(row: int, value: int, code: str) -> None:
    machine = bench()
    assert machine.path is not None
    columns = [list(column) for column in machine.path.offset]
    columns[0][row] = value
    machine.path = CorrectedPath(0, machine.path.demand, tuple(columns), True, DIGEST, 1)
    machine.settle()
    machine.arm()
    machine.run(30)
    machine.play()
    machine.run_until(Mode.ACTIVE)
    machine.run_until(Mode.OFF)
    assert machine.alarms[-1] == Alarm(code, "X")
    sent = [offsets[0] for _, offsets in machine.frames]
    limits = machine.settings.axes[0].limits
    assert max(abs(b - a) for a, b in itertools.pairwise(sent)) <= limits.hard_rate


@pytest.mark.fault("E5")
def test_table_replaced_by_another_program_ramps_down(cutting_machine: Bench, record_property: Tell) -> None:
    assert cutting_machine.path is not None
    since = cutting_machine.tick
    cutting_machine.path = CorrectedPath(0, cutting_machine.path.demand, cutting_machine.path.offset, True, "other", 2)
    cutting_machine.run_sync()
    assert cutting_machine.mode is Mode.RAMP_DOWN
    assert cutting_machine.alarms[-1].code == "ProgramMismatch"
    cutting_machine.run_until(Mode.OFF)
    record_property("sync_to_zero", cutting_machine.to_zero(since))


def test_streamed_table_that_runs_dry_ramps_down_in_time(cutting_machine: Bench) -> None:
    assert cutting_machine.path is not None
    path = cutting_machine.path
    cutting_machine.path = CorrectedPath(0, path.demand, path.offset, False, DIGEST, 2)
    cutting_machine.run_sync()
    assert cutting_machine.alarms[-1].code == "TableStarved"


def test_streamed_table_needs_one_second_of_rows(cutting_machine: Bench) -> None:
    assert cutting_machine.path is not None
    path, row = cutting_machine.path, cutting_machine.state.places[0].row + 1
    last = path.end - 1
    for rows, mode in ((1000, Mode.ACTIVE), (999, Mode.RAMP_DOWN)):
        machine = copy.deepcopy(cutting_machine)
        more = row + rows - path.end
        demand, offset = ([[*c, *[c[last]] * more] for c in columns] for columns in (path.demand, path.offset))
        machine.path = CorrectedPath(0, tuple(demand), tuple(offset), False, DIGEST, 2)
        machine.run_sync()
        assert machine.mode is mode, rows


@pytest.mark.fault("E2")
def test_oscillating_table_ramps_down_by_its_total_variation() -> None:
    machine = bench()
    assert machine.path is not None
    wave = [(k // 8 % 2 * 2 - 1) * (k % 8 if k % 8 < 4 else 8 - k % 8) * 6 for k in range(600)]
    machine.path = CorrectedPath(0, machine.path.demand, (wave, machine.path.offset[1]), True, DIGEST, 1)
    tight = OffsetLimits(819, 65, 12, 500, 1000)
    machine.settings = replace(machine.settings, axes=tuple(replace(a, limits=tight) for a in machine.settings.axes))
    machine.settle()
    machine.arm()
    machine.run(30)
    machine.play()
    machine.run_until(Mode.RAMP_DOWN)
    assert machine.alarms[-1] == Alarm("OffsetEnergy", "X")


@pytest.mark.parametrize("rate", [0.5, 0.9, 1.2])
@pytest.mark.fault("E17")
def test_changed_override_is_distinguished_from_another_path(cutting_machine: Bench, rate: float) -> None:
    at = float(cutting_machine.row)
    while cutting_machine.mode is not Mode.RAMP_DOWN:
        at += rate
        k, part = int(at), at - int(at)
        cutting_machine.rest = [round(c[k] + part * (c[k + 1] - c[k])) for c in cutting_machine.demand]
        cutting_machine.run_sync()
    assert cutting_machine.alarms[-1].code == "OverrideChanged"
    assert f"{100 * rate:.0f} %" in cutting_machine.alarms[-1].detail
    cutting_machine.run_until(Mode.OFF)


def test_shift_along_the_path_is_not_an_override(cutting_machine: Bench) -> None:
    cutting_machine.row += 2
    cutting_machine.run_until(Mode.RAMP_DOWN)
    assert cutting_machine.alarms[-1].code == "Misaligned"
