"""The guard adopts only a trusted offset of a drive; no reading may become a step."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Mapping
from dataclasses import replace

import pytest

from fdhil.guard import core
from fdhil.guard.adoption import may_stand
from fdhil.guard.interlocks import Alarm
from fdhil.guard.limits import follow
from fdhil.guard.protocol import Mode
from fdhil.guard.state import Request
from tests.guard.machine import RECORD, Bench, arm_request, bench

ADOPT = Request("adopt", token_valid=True)


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
        machine.sync()
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
def test_a_believed_offset_is_ramped_from_its_value() -> None:
    machine = holding(-500, 819)
    assert may_stand(machine.state) == (None, None)
    machine.until(Mode.ADOPT)
    assert machine.tick > 20  # three TPDOs, not one
    machine.until(Mode.OFF)
    assert may_stand(machine.state) == (0, 0)
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
def test_what_may_not_be_believed_is_frozen_and_told(machine: Bench, expected: str) -> None:
    machine.run(150)
    assert machine.mode is Mode.FROZEN
    assert machine.frames == []
    assert machine.heartbeats == []
    assert machine.state.cause is not None
    assert machine.state.cause.code == "OffsetDoubtful"
    assert expected in machine.state.cause.sentence()
    assert may_stand(machine.state) == tuple(drive.offset for drive in machine.drives)
    assert codes(machine.sync(ADOPT).refused) & {"OffsetDoubtful", "NotCommissioned", "RecordVoid"}
    assert "NotOff" in codes(machine.sync(arm_request()).refused)


@pytest.mark.parametrize("target", [327680, 800])
@pytest.mark.fault("A17")
def test_a_remapped_read_back_is_not_believed(target: int) -> None:
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
def test_forged_frames_beside_the_drives_own_move_nothing(at: int, times: int) -> None:
    machine = bench()
    machine.run(at)
    for _ in range(times):
        machine.hear(0x381, struct.pack("<ii", 500, 500))
        machine.sync()
    machine.run(150)
    assert machine.frames == []
    assert machine.mode is Mode.OFF
    assert machine.arm() == ()


@pytest.mark.parametrize("phase", range(1, 10))
def test_another_node_in_step_with_the_drive_is_not_believed(phase: int) -> None:
    machine = bench()
    for _ in range(200):
        machine.sync()
        if machine.tick % 10 == phase:
            machine.hear(0x381, struct.pack("<ii", 500, 500))
    assert machine.frames == []
    assert may_stand(machine.state)[0] != 500


def test_an_offset_that_is_never_shown_alike_is_frozen() -> None:
    machine = bench()
    for k in range(200):
        machine.drives[0].hold(100 + k)
        machine.sync()
    assert machine.mode is Mode.FROZEN
    assert machine.frames == []


def test_a_drive_that_boots_at_rest_is_read_anew() -> None:
    machine = bench()
    machine.settle()
    while machine.tick % 10 != 3:
        machine.sync()
    machine.reboot(0)
    machine.sync()
    assert may_stand(machine.state) == (None, None)
    assert "ReadBackStale" in codes(machine.arm())
    machine.run(30)
    assert may_stand(machine.state) == (0, 0)


def test_nothing_is_armed_while_the_read_back_is_silent() -> None:
    """A restart with -91.6 um in the drive and its TPDO3 missing: the unknown offset refuses arming."""
    machine = holding(-300, 0)
    for _ in range(300):
        machine.sync(drop=(0x381,))
    assert machine.mode is Mode.OFF
    assert may_stand(machine.state) == (None, 0)
    assert "ReadBackStale" in codes(machine.sync(arm_request(), drop=(0x381,)).refused)
    assert "OffsetDoubtful" in codes(machine.sync(ADOPT, drop=(0x381,)).refused)
    assert machine.frames == []


def test_a_drive_that_shows_no_offset_is_not_armed() -> None:
    machine = bench()
    axes = [replace(axis, tpdos=(*axis.tpdos[:2], axis.tpdos[3])) for axis in machine.settings.axes]
    machine = Bench(replace(machine.settings, axes=tuple(axes)), machine.path, machine.demand, machine.drives)
    machine.settle()
    assert machine.settings.axes[0].read_back_every == 0
    assert codes(machine.arm()) == {"ReadBackStale"}


# --- while it sends ---


def test_a_read_back_that_stops_ends_the_correction() -> None:
    machine = active()
    begin, frames = len(machine.held), len(machine.frames)
    for _ in range(25):
        machine.sync(drop=(0x381,))
    assert machine.mode is Mode.RAMP_DOWN
    assert [alarm.code for alarm in machine.alarms] == ["ReadBackStale"]
    for _ in range(150):
        machine.sync(drop=(0x381,))
    assert machine.state.mode is Mode.FROZEN  # zeros were sent, and not read back
    assert machine.frames[-1][1] == (0, 0)
    assert len(machine.frames) > frames + 50
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate
    assert may_stand(machine.state) == (None, 0)


def test_one_lost_read_back_is_forgiven() -> None:
    machine = active()
    while machine.tick % 10:
        machine.sync()
    machine.sync(drop=(0x381,))
    machine.run(15)
    assert machine.alarms == []


def foreign_frame(machine: Bench, value: int) -> None:
    machine.inject(0x301, struct.pack("<i", value))


def foreign_sdo(machine: Bench, value: int) -> None:
    machine.inject(0x601, struct.pack("<BHBi", 0x23, 0x60B0, 0, value))


@pytest.mark.parametrize("write", [foreign_frame, foreign_sdo])
@pytest.mark.parametrize("value", [-819, 0, 300])
@pytest.mark.fault("A19")
def test_after_a_foreign_offset_the_ramp_starts_from_what_is_measured(
    write: Callable[[Bench, int], None], value: int
) -> None:
    machine = active()
    write(machine, value)
    frames = len(machine.frames)
    machine.sync()
    begin = len(machine.held)
    assert machine.mode is Mode.RAMP_DOWN
    assert may_stand(machine.state) == (None, None)
    machine.run(19)
    assert len(machine.frames) == frames  # nothing until it is known
    machine.until(Mode.OFF, 200)
    assert [alarm.code for alarm in machine.alarms] == ["OffsetHijack"] * len(machine.alarms)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate
    assert machine.held[-1] == (0, 0)


@pytest.mark.parametrize("mode", [Mode.ADOPT, Mode.RAMP_DOWN])
@pytest.mark.fault("A19")
def test_a_foreign_offset_while_it_lands_is_measured_and_landed_from_there(mode: Mode) -> None:
    machine = holding(600, 0) if mode is Mode.ADOPT else active()
    if mode is Mode.RAMP_DOWN:
        machine.sync(Request("disarm"))
    machine.until(mode)
    foreign_frame(machine, 300)
    machine.sync()
    begin = len(machine.held)
    assert (machine.mode, machine.state.measuring) == (Mode.RAMP_DOWN, 2)
    assert machine.state.cause is not None
    assert machine.state.cause.code == "OffsetHijack"
    machine.until(Mode.OFF, 200)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate
    assert machine.held[-1] == (0, 0)


@pytest.mark.fault("A19")
def test_a_foreign_offset_beyond_the_ceiling_freezes() -> None:
    machine = active()
    frames = len(machine.frames)
    machine.inject(0x301, struct.pack("<i", 2000))
    machine.run(100)
    assert machine.mode is Mode.FROZEN
    assert len(machine.frames) == frames
    assert may_stand(machine.state)[0] == 2000
    assert machine.state.cause is not None
    assert machine.state.cause.detail.startswith("610.4 um may still be applied")


@pytest.mark.fault("A19")
def test_a_foreign_node_that_goes_on_is_not_fought() -> None:
    machine = active()
    frames = len(machine.frames)
    for k in range(100):
        machine.inject(0x301, struct.pack("<i", 300 + k % 2))
        machine.sync()
    assert machine.mode is Mode.FROZEN
    assert len(machine.frames) == frames


def test_a_foreign_offset_while_armed_is_not_called_off() -> None:
    machine = bench()
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.inject(0x301, struct.pack("<i", 2000))
    machine.sync()
    machine.listener.error("off")
    machine.sync()
    assert machine.mode is Mode.FROZEN


def test_a_flood_of_other_events_does_not_hide_a_foreign_offset() -> None:
    machine = active()
    for k in range(40):
        machine.hear(0x081, struct.pack("<H6x", 0x3000 + k))
    machine.inject(0x301, struct.pack("<i", -819))
    machine.sync()
    begin = len(machine.held)
    machine.until(Mode.OFF, 300)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate


def test_no_frame_is_beyond_the_compiled_ceiling(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are bounded by 250 um, whatever settings and state contain."""
    machine = active()
    limits = replace(machine.settings.axes[0].limits, offset=32768, rate=3000, acceleration=3000)
    machine.settings = replace(
        machine.settings, axes=tuple(replace(axis, limits=limits) for axis in machine.settings.axes)
    )
    count = len(machine.frames)
    monkeypatch.setattr(core, follow.__name__, lambda *_: 820)
    machine.sync(Request("disarm"))
    assert machine.mode is Mode.FROZEN
    assert machine.alarms[-1].code == "InternalError"
    assert len(machine.frames) == count


def test_what_may_stand_while_it_sends_is_what_was_sent_or_shown() -> None:
    machine = active()
    assert may_stand(machine.state) == machine.frames[-1][1]
    machine.drives[0].scale = 0.5
    while not machine.state.axes[0].echo_misses:
        machine.sync()
    result = may_stand(machine.state)
    assert result[0] == machine.state.axes[0].read_back != machine.frames[-1][1][0]


def test_a_zero_that_was_shown_at_the_end_stays_known() -> None:
    machine = active()
    machine.sync(Request("disarm"))
    machine.until(Mode.OFF)
    for drive in machine.drives:
        drive.answers = False
    machine.run(50)
    assert may_stand(machine.state) == (0, 0)
    machine.inject(0x302, struct.pack("<i", 300))
    machine.sync()
    assert may_stand(machine.state) == (None, None)


# --- out of FROZEN ---


def test_adopt_leads_out_of_frozen_once_the_drives_were_read() -> None:
    machine = active()
    machine.listener.error("off")
    machine.sync()
    begin = len(machine.held)
    assert may_stand(machine.state)[0] == machine.frames[-1][1][0]
    machine.listener.error("active")
    assert "OffsetDoubtful" in codes(machine.sync(ADOPT).refused)
    machine.run(35)
    assert may_stand(machine.state) == machine.held[-1]
    assert machine.sync(ADOPT).refused == ()
    machine.until(Mode.OFF)
    assert may_stand(machine.state) == (0, 0)
    assert largest_step(machine, begin) <= machine.settings.axes[0].limits.hard_rate


def test_adopt_of_nothing_is_off_without_a_frame() -> None:
    """Beyond the ceiling the only way out is to switch the drive off and on: it then shows zero."""
    machine = holding(5000, 0, record="")
    machine.run(150)
    assert machine.mode is Mode.FROZEN
    machine.reboot(0)
    machine.hear(0x701, b"\x05")
    machine.run(40)
    assert machine.sync(Request("adopt")).refused == (Alarm("AuthRequired"),)
    assert machine.sync(ADOPT).refused == ()
    assert machine.state.mode is Mode.OFF
    assert machine.frames == []
    assert may_stand(machine.state) == (0, 0)


# --- what voids a record ---


def write_6065(machine: Bench) -> None:
    machine.hear(0x601, struct.pack("<BHBI", 0x23, 0x6065, 0, 0xFFFFFFFF))


def write_mapping_as_block(machine: Bench) -> None:
    machine.hear(0x601, struct.pack("<BHBI", 0xC2, 0x1A02, 1, 4))


def restart(machine: Bench) -> None:
    machine.reboot(0)
    machine.hear(0x701, b"\x05")


@pytest.mark.parametrize("touch", [write_6065, write_mapping_as_block, restart])
@pytest.mark.fault("A17")
def test_a_touched_drive_is_not_armed_until_it_was_compared(touch: Callable[[Bench], None]) -> None:
    machine = bench()
    machine.settle()
    touch(machine)
    machine.settle()
    assert codes(machine.arm()) == {"RecordVoid"}
    touched = {"X": machine.state.axes[0].touched, "Y": 0}
    compared = Request("compared", True, compared={"X": RECORD}, touched=touched)
    assert codes(machine.sync(replace(compared, token_valid=False)).refused) == {"AuthRequired"}
    assert codes(machine.sync(replace(compared, compared={"X": "another"})).refused) == {"RecordVoid"}
    assert machine.sync(replace(compared, compared={"Y": RECORD})).refused == ()
    assert codes(machine.arm()) == {"RecordVoid"}
    assert machine.sync(compared).refused == ()
    assert machine.arm() == ()
    assert codes(machine.sync(compared).refused) == {"NotOff"}


@pytest.mark.parametrize("touched", [{"X": 1}, {"X": 3}, {"Y": 2}, {}])
@pytest.mark.fault("A17")
def test_a_drive_that_was_touched_after_it_was_compared_stays_void(touched: Mapping[str, int]) -> None:
    machine = bench()
    machine.settle()
    restart(machine)
    machine.settle()
    restart(machine)
    machine.settle()
    asked = Request("compared", True, compared={"X": RECORD}, touched=touched)
    expected = Alarm("RecordVoid", "X", "after it was compared")
    assert machine.sync(asked).refused == (expected,)
    assert codes(machine.arm()) == {"RecordVoid"}
    restart(machine)  # in the very cycle in which the guard is told
    assert machine.sync(replace(asked, touched={"X": 2})).refused == (expected,)
    assert machine.sync(replace(asked, touched={"X": 3})).refused == ()


def test_a_write_while_it_runs_ends_nothing_and_arms_nothing_more() -> None:
    machine = active()
    write_6065(machine)
    machine.run(30)
    assert machine.mode is Mode.ACTIVE
    machine.sync(Request("disarm"))
    machine.until(Mode.OFF)
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
def test_what_touches_nothing_voids_nothing(frame: bytes) -> None:
    machine = bench()
    machine.settle()
    machine.hear(0x601, frame)
    machine.hear(0x609, struct.pack("<BHBI", 0x23, 0x6065, 0, 0))  # another node's
    machine.sync()
    assert machine.arm() == ()


def test_a_drive_without_a_record_is_not_armed() -> None:
    machine = holding(0, 0, record="")
    machine.settle()
    assert codes(machine.arm()) == {"NotCommissioned"}
