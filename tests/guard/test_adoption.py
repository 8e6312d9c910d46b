"""The guard adopts only a trusted offset of a drive; no reading may become a step."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace

import pytest

from fdhil.guard import guard_step
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardRequest
from fdhil.guard.interlocks import Alarm
from fdhil.guard.offset_adoption import list_applied_offsets
from fdhil.guard.offset_limits import move_toward_goal
from tests.guard.simulated_bus import RECORD, Bench, arm_request, bench

ADOPT = GuardRequest("adopt", token_valid=True)


def holding(*offsets: int, **changes: object) -> Bench:
    machine = bench()
    axes = tuple(replace(axis, **changes) for axis in machine.settings.axes)  # type: ignore[arg-type]
    machine = Bench(replace(machine.settings, axes=axes), machine.path, machine.demand, machine.drives)
    for drive, offset in zip(machine.drives, offsets, strict=True):
        drive.hold(offset)
    return machine


def active(offset: int = 600) -> Bench:
    machine = bench(amplitude=800)
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    while machine.offsets[0] < offset:
        machine.run_sync()
    assert machine.mode is Mode.ACTIVE
    machine.alarms.clear()
    return machine


def largest_step(machine: Bench, since: int) -> int:
    held = machine.held[since:]
    return max(abs(b - a) for before, after in itertools.pairwise(held) for a, b in zip(before, after, strict=True))


def codes(refused: tuple[Alarm, ...] | None) -> set[str]:
    assert refused is not None
    return {alarm.code for alarm in refused}


# --- at the start ---


@pytest.mark.fault("E13")
def test_trusted_offset_at_start_is_ramped_to_zero_from_its_value() -> None:
    machine = holding(-500, 819)
    assert list_applied_offsets(machine.state) == (None, None)
    machine.run_until(Mode.ADOPT)
    assert machine.tick > 20  # three TPDOs, not one
    machine.run_until(Mode.OFF)
    assert list_applied_offsets(machine.state) == (0, 0)
    assert [drive.offset for drive in machine.drives] == [0, 0]
    assert largest_step(machine, 0) <= machine.settings.axes[0].limits.hard_rate


@pytest.mark.parametrize(
    ("machine", "expected"),
    [
        (holding(820, 0), "250.2 um may still be applied: beyond the ceiling"),
        (holding(0, -327680), "-100000.0 um may still be applied: beyond the ceiling"),
        (holding(500, 0, record=""), "152.6 um may still be applied: axis X: there is no valid commissioning record"),
        (holding(500, 0, record_void=True), "152.6 um may still be applied: axis X: the drive has rebooted"),
    ],
)
def test_untrusted_offset_freezes_and_is_reported(machine: Bench, expected: str) -> None:
    machine.run(150)
    assert machine.mode is Mode.FROZEN
    assert machine.frames == []
    assert machine.heartbeats == []
    assert machine.state.cause is not None
    assert machine.state.cause.code == "OffsetDoubtful"
    assert expected in machine.state.cause.sentence()
    assert list_applied_offsets(machine.state) == tuple(drive.offset for drive in machine.drives)
    assert codes(machine.run_sync(ADOPT).refused) & {"OffsetDoubtful", "NotCommissioned", "RecordVoid"}
    assert "NotOff" in codes(machine.run_sync(arm_request()).refused)


@pytest.mark.parametrize("target", [327680, 800])
@pytest.mark.fault("A17")
def test_read_back_of_a_remapped_pdo_is_not_trusted(target: int) -> None:
    """0x60B0 and 0x6062 are swapped: nothing is sent, within the ceiling or not."""
    machine = bench()
    machine.rest = [target, 0]
    machine.drives[0].remapped = True
    machine.run(200)
    assert machine.mode is Mode.FROZEN
    assert machine.frames == []


@pytest.mark.parametrize("at", range(10))
@pytest.mark.parametrize("times", [1, 2, 3, 9])
@pytest.mark.fault("G9")
def test_forged_frames_next_to_the_drives_own_do_not_move_the_offset(at: int, times: int) -> None:
    machine = bench()
    machine.run(at)
    for _ in range(times):
        machine.receive_frames(0x381, struct.pack("<ii", 500, 500))
        machine.run_sync()
    machine.run(150)
    assert machine.frames == []
    assert machine.mode is Mode.OFF
    assert machine.arm() == ()


@pytest.mark.parametrize("phase", range(1, 10))
def test_read_back_of_a_synchronous_foreign_node_is_not_trusted(phase: int) -> None:
    machine = bench()
    for _ in range(200):
        machine.run_sync()
        if machine.tick % 10 == phase:
            machine.receive_frames(0x381, struct.pack("<ii", 500, 500))
    assert machine.frames == []
    assert list_applied_offsets(machine.state)[0] != 500


def test_guard_freezes_when_read_backs_never_agree() -> None:
    machine = bench()
    for k in range(200):
        machine.drives[0].hold(100 + k)
        machine.run_sync()
    assert machine.mode is Mode.FROZEN
    assert machine.frames == []


def test_read_back_is_confirmed_again_after_a_drive_reboots_while_idle() -> None:
    machine = bench()
    machine.settle()
    while machine.tick % 10 != 3:
        machine.run_sync()
    machine.reboot(0)
    machine.run_sync()
    assert list_applied_offsets(machine.state) == (None, None)
    assert "ReadBackStale" in codes(machine.arm())
    machine.run(30)
    assert list_applied_offsets(machine.state) == (0, 0)


def test_arming_is_refused_without_read_back() -> None:
    """A restart with -91.6 um in the drive and its TPDO3 missing: the unknown offset refuses arming."""
    machine = holding(-300, 0)
    for _ in range(300):
        machine.run_sync(drop=(0x381,))
    assert machine.mode is Mode.OFF
    assert list_applied_offsets(machine.state) == (None, 0)
    assert "ReadBackStale" in codes(machine.run_sync(arm_request(), drop=(0x381,)).refused)
    assert "OffsetDoubtful" in codes(machine.run_sync(ADOPT, drop=(0x381,)).refused)
    assert machine.frames == []


def test_arming_is_refused_for_a_drive_that_reports_no_offset() -> None:
    machine = bench()
    axes = [replace(axis, tpdos=(*axis.tpdos[:2], axis.tpdos[3])) for axis in machine.settings.axes]
    machine = Bench(replace(machine.settings, axes=tuple(axes)), machine.path, machine.demand, machine.drives)
    machine.settle()
    assert machine.settings.axes[0].read_back_every == 0
    assert codes(machine.arm()) == {"ReadBackStale"}


# --- while it sends ---


def test_correction_ends_when_the_read_back_stops() -> None:
    machine = active()
    begin, frames = len(machine.held), len(machine.frames)
    for _ in range(25):
        machine.run_sync(drop=(0x381,))
    assert machine.mode is Mode.RAMP_DOWN
    assert [alarm.code for alarm in machine.alarms] == ["ReadBackStale"]
    for _ in range(150):
        machine.run_sync(drop=(0x381,))
    assert machine.state.mode is Mode.FROZEN  # zeros were sent, and not read back
    assert machine.frames[-1][1] == (0, 0)
    assert len(machine.frames) > frames + 50
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate
    assert list_applied_offsets(machine.state) == (None, 0)


def test_one_lost_read_back_is_tolerated() -> None:
    machine = active()
    while machine.tick % 10:
        machine.run_sync()
    machine.run_sync(drop=(0x381,))
    machine.run(15)
    assert machine.alarms == []


def foreign_frame(machine: Bench, value: int) -> None:
    machine.inject_frame(0x301, struct.pack("<i", value))


def foreign_sdo(machine: Bench, value: int) -> None:
    machine.inject_frame(0x601, struct.pack("<BHBi", 0x23, 0x60B0, 0, value))


@pytest.mark.parametrize("write", [foreign_frame, foreign_sdo])
@pytest.mark.parametrize("value", [-819, 0, 300])
@pytest.mark.fault("A19")
def test_ramp_after_a_foreign_offset_starts_from_the_read_back(write: Callable[[Bench, int], None], value: int) -> None:
    machine = active()
    write(machine, value)
    frames = len(machine.frames)
    machine.run_sync()
    begin = len(machine.held)
    assert machine.mode is Mode.RAMP_DOWN
    assert list_applied_offsets(machine.state) == (None, None)
    machine.run(19)
    assert len(machine.frames) == frames  # nothing until it is known
    machine.run_until(Mode.OFF, 200)
    assert [alarm.code for alarm in machine.alarms] == ["OffsetHijack"] * len(machine.alarms)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate
    assert machine.held[-1] == (0, 0)


@pytest.mark.parametrize("mode", [Mode.ADOPT, Mode.RAMP_DOWN])
@pytest.mark.fault("A19")
def test_foreign_offset_during_a_ramp_down_is_ramped_from_its_read_back(mode: Mode) -> None:
    machine = holding(600, 0) if mode is Mode.ADOPT else active()
    if mode is Mode.RAMP_DOWN:
        machine.run_sync(GuardRequest("disarm"))
    machine.run_until(mode)
    foreign_frame(machine, 300)
    machine.run_sync()
    begin = len(machine.held)
    assert (machine.mode, machine.state.measuring) == (Mode.RAMP_DOWN, 2)
    assert machine.state.cause is not None
    assert machine.state.cause.code == "OffsetHijack"
    machine.run_until(Mode.OFF, 200)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate
    assert machine.held[-1] == (0, 0)


@pytest.mark.fault("A19")
def test_foreign_offset_beyond_the_ceiling_freezes() -> None:
    machine = active()
    frames = len(machine.frames)
    machine.inject_frame(0x301, struct.pack("<i", 2000))
    machine.run(100)
    assert machine.mode is Mode.FROZEN
    assert len(machine.frames) == frames
    assert list_applied_offsets(machine.state)[0] == 2000
    assert machine.state.cause is not None
    assert machine.state.cause.detail.startswith("610.4 um may still be applied")


@pytest.mark.fault("A19")
def test_guard_freezes_when_a_foreign_node_keeps_writing() -> None:
    machine = active()
    frames = len(machine.frames)
    for k in range(100):
        machine.inject_frame(0x301, struct.pack("<i", 300 + k % 2))
        machine.run_sync()
    assert machine.mode is Mode.FROZEN
    assert len(machine.frames) == frames


def test_foreign_offset_while_armed_still_ends_the_correction() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.inject_frame(0x301, struct.pack("<i", 2000))
    machine.run_sync()
    machine.listener.set_controller_state("off")
    machine.run_sync()
    assert machine.mode is Mode.FROZEN


def test_foreign_offset_is_detected_in_a_flood_of_other_events() -> None:
    machine = active()
    for k in range(40):
        machine.receive_frames(0x081, struct.pack("<H6x", 0x3000 + k))
    machine.inject_frame(0x301, struct.pack("<i", -819))
    machine.run_sync()
    begin = len(machine.held)
    machine.run_until(Mode.OFF, 300)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate


def test_no_frame_exceeds_the_compiled_ceiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are bounded by 250 um, whatever settings and state contain."""
    machine = active()
    limits = replace(machine.settings.axes[0].limits, offset=32768, rate=3000, acceleration=3000)
    machine.settings = replace(
        machine.settings, axes=tuple(replace(axis, limits=limits) for axis in machine.settings.axes)
    )
    count = len(machine.frames)
    monkeypatch.setattr(guard_step, move_toward_goal.__name__, lambda *_: 820)
    machine.run_sync(GuardRequest("disarm"))
    assert machine.mode is Mode.FROZEN
    assert machine.alarms[-1].code == "InternalError"
    assert len(machine.frames) == count


def test_applied_offset_while_sending_is_the_sent_or_shown_one() -> None:
    machine = active()
    assert list_applied_offsets(machine.state) == machine.frames[-1][1]
    machine.drives[0].scale = 0.5
    while not machine.state.axes[0].echo_misses:
        machine.run_sync()
    result = list_applied_offsets(machine.state)
    assert result[0] == machine.state.axes[0].read_back != machine.frames[-1][1][0]


def test_confirmed_zero_stays_confirmed_after_the_ramp() -> None:
    machine = active()
    machine.run_sync(GuardRequest("disarm"))
    machine.run_until(Mode.OFF)
    for drive in machine.drives:
        drive.answers = False
    machine.run(50)
    assert list_applied_offsets(machine.state) == (0, 0)
    machine.inject_frame(0x302, struct.pack("<i", 300))
    machine.run_sync()
    assert list_applied_offsets(machine.state) == (None, None)


# --- out of FROZEN ---


def test_adopt_leaves_frozen_once_the_read_backs_are_confirmed() -> None:
    machine = active()
    machine.listener.set_controller_state("off")
    machine.run_sync()
    begin = len(machine.held)
    assert list_applied_offsets(machine.state)[0] == machine.frames[-1][1][0]
    machine.listener.set_controller_state("active")
    assert "OffsetDoubtful" in codes(machine.run_sync(ADOPT).refused)
    machine.run(35)
    assert list_applied_offsets(machine.state) == machine.held[-1]
    assert machine.run_sync(ADOPT).refused == ()
    machine.run_until(Mode.OFF)
    assert list_applied_offsets(machine.state) == (0, 0)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate


def test_adopt_with_zero_offsets_goes_off_without_sending() -> None:
    """Beyond the ceiling the only way out is to switch the drive off and on: it then shows zero."""
    machine = holding(5000, 0, record="")
    machine.run(150)
    assert machine.mode is Mode.FROZEN
    machine.reboot(0)
    machine.receive_frames(0x701, b"\x05")
    machine.run(40)
    assert machine.run_sync(GuardRequest("adopt")).refused == (Alarm("AuthRequired"),)
    assert machine.run_sync(ADOPT).refused == ()
    assert machine.state.mode is Mode.OFF
    assert machine.frames == []
    assert list_applied_offsets(machine.state) == (0, 0)


# --- what voids a record ---


def write_6065(machine: Bench) -> None:
    machine.receive_frames(0x601, struct.pack("<BHBI", 0x23, 0x6065, 0, 0xFFFFFFFF))


def write_mapping_as_block(machine: Bench) -> None:
    machine.receive_frames(0x601, struct.pack("<BHBI", 0xC2, 0x1A02, 1, 4))


def restart(machine: Bench) -> None:
    machine.reboot(0)
    machine.receive_frames(0x701, b"\x05")


@pytest.mark.parametrize("touch", [write_6065, write_mapping_as_block, restart])
@pytest.mark.fault("A17")
def test_rebooted_or_written_drive_is_armed_only_after_comparison(touch: Callable[[Bench], None]) -> None:
    machine = bench()
    machine.settle()
    touch(machine)
    machine.settle()
    assert codes(machine.arm()) == {"RecordVoid"}
    touched = {"X": machine.state.axes[0].touched, "Y": 0}
    compared = GuardRequest("compared", True, compared={"X": RECORD}, touched=touched)
    assert codes(machine.run_sync(replace(compared, token_valid=False)).refused) == {"AuthRequired"}
    assert codes(machine.run_sync(replace(compared, compared={"X": "another"})).refused) == {"RecordVoid"}
    assert machine.run_sync(replace(compared, compared={"Y": RECORD})).refused == ()
    assert codes(machine.arm()) == {"RecordVoid"}
    assert machine.run_sync(compared).refused == ()
    assert machine.arm() == ()
    assert codes(machine.run_sync(compared).refused) == {"NotOff"}


@pytest.mark.parametrize("touched", [{"X": 1}, {"X": 3}, {"Y": 2}, {}])
@pytest.mark.fault("A17")
def test_record_stays_void_when_the_drive_is_written_after_comparison(touched: Mapping[str, int]) -> None:
    machine = bench()
    machine.settle()
    restart(machine)
    machine.settle()
    restart(machine)
    machine.settle()
    asked = GuardRequest("compared", True, compared={"X": RECORD}, touched=touched)
    expected = Alarm("RecordVoid", "X", "after it was compared")
    assert machine.run_sync(asked).refused == (expected,)
    assert codes(machine.arm()) == {"RecordVoid"}
    restart(machine)  # in the very cycle in which the guard is told
    assert machine.run_sync(replace(asked, touched={"X": 2})).refused == (expected,)
    assert machine.run_sync(replace(asked, touched={"X": 3})).refused == ()


def test_write_during_a_correction_does_not_end_it_but_prevents_arming() -> None:
    machine = active()
    write_6065(machine)
    machine.run(30)
    assert machine.mode is Mode.ACTIVE
    machine.run_sync(GuardRequest("disarm"))
    machine.run_until(Mode.OFF)
    machine.settle()
    assert codes(machine.arm()) == {"RecordVoid"}


@pytest.mark.parametrize(
    "frame",
    [
        struct.pack("<BHBI", 0x40, 0x6065, 0, 0),  # an upload
        struct.pack("<BHBI", 0x2F, 0x6060, 0, 8),  # the mode of operation is the NC's
        struct.pack("<BHBI", 0xC1, 0x6065, 0, 0),  # the end of a block
        b"\x23\x65",
    ],
)
def test_harmless_frames_do_not_void_the_record(frame: bytes) -> None:
    machine = bench()
    machine.settle()
    machine.receive_frames(0x601, frame)
    machine.receive_frames(0x609, struct.pack("<BHBI", 0x23, 0x6065, 0, 0))  # another node's
    machine.run_sync()
    assert machine.arm() == ()


def test_drive_without_a_record_is_not_armed() -> None:
    machine = holding(0, 0, record="")
    machine.settle()
    assert codes(machine.arm()) == {"NotCommissioned"}
