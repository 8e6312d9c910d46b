"""A second master that writes a drive's offset by any COB-ID: nothing is adopted and nothing overwritten repeatedly."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import pytest

from fdhil.errors import ConfigError
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import decode_settings, encode_settings
from fdhil.guard.guard_state import GuardRequest
from tests.guard.simulated_bus import Bench, Drive, Frame, bench

WRITER, PITCH_ERROR, PERIOD = 0x501, 197, 25
"""An RPDO of drive X that carries 60B0; 60.1 um every 25 SYNC, as an NC that compensates a screw's pitch sends them."""
ADOPT = GuardRequest("adopt", token_valid=True)


def written_by(*cob_ids: int, amplitude: int = 800) -> Bench:
    machine = bench(amplitude=amplitude)
    axes = machine.settings.axes
    settings = replace(machine.settings, axes=(replace(axes[0], writers=cob_ids), *axes[1:]))
    return Bench(settings, machine.path, machine.demand, machine.drives)


def write(machine: Bench, value: int = PITCH_ERROR, cob_id: int = WRITER) -> None:
    machine.receive_frames(cob_id, struct.pack("<i", value))
    machine.drives[0].received_offset = value


def run(machine: Bench, cycles: int, value: Callable[[int], int] = lambda _tick: PITCH_ERROR) -> None:
    for _ in range(cycles):
        machine.run_sync()
        if machine.tick % PERIOD == 0:
            write(machine, value(machine.tick))


def cutting(machine: Bench, offset: int = 300) -> Bench:
    machine.settle()
    assert machine.arm() == ()
    machine.run(30)
    machine.play()
    while machine.offsets[0] < offset:
        machine.run_sync()
    machine.alarms.clear()
    return machine


def cause(machine: Bench) -> tuple[str, str]:
    assert machine.state.cause is not None
    return machine.state.cause.code, machine.state.cause.axis


def test_guard_adopts_no_offset_that_another_master_writes() -> None:
    machine = written_by(WRITER)
    machine.drives[0].hold(PITCH_ERROR)
    run(machine, 600)
    assert machine.frames == []
    assert (machine.mode, cause(machine)) == (Mode.FROZEN, ("OffsetHijack", "X"))
    refused = machine.run_sync(ADOPT).refused
    assert refused is not None
    assert "OffsetHijack" in {alarm.code for alarm in refused}
    assert machine.frames == []


def test_offset_of_a_silent_foreign_master_can_be_adopted() -> None:
    machine = written_by(WRITER)
    machine.drives[0].hold(PITCH_ERROR)
    run(machine, 100)
    machine.run(1100)
    assert machine.frames == []
    assert machine.run_sync(ADOPT).refused == ()
    machine.run_until(Mode.OFF)
    assert machine.held[-1] == (0, 0)


def test_offset_that_changes_without_the_guard_is_not_adopted() -> None:
    """The other master uses an unknown COB-ID; its offset varies along the axis."""
    machine = written_by()
    machine.drives[0].hold(PITCH_ERROR)
    for _ in range(8):
        machine.run_sync()
    for _ in range(400):
        machine.run_sync()
        if machine.tick % PERIOD == 0:
            machine.drives[0].hold(PITCH_ERROR + machine.tick)
    assert machine.frames == []
    assert (machine.mode, cause(machine)) == (Mode.FROZEN, ("OffsetHijack", "X"))


@dataclass
class LateDrive(Drive):
    waits: list[int | None] = field(default_factory=lambda: [None])

    def at_sync(self, tick: int) -> list[Frame]:
        self.waits.append(self.received_offset)
        self.received_offset = self.waits.pop(0)
        frames = super().at_sync(tick)
        extra = [(0x380 + self.node_id, struct.pack("<ii", self.followed or 0, self.offset))] if tick % 10 else []
        return frames + extra


def test_late_read_back_is_not_attributed_to_another_master() -> None:
    plain = bench(amplitude=800)
    axes = [
        replace(
            axis,
            tpdos=tuple(replace(pdo, every_sync=1 if pdo.cob_id >> 7 == 7 else pdo.every_sync) for pdo in axis.tpdos),
        )
        for axis in plain.settings.axes
    ]
    machine = Bench(replace(plain.settings, axes=tuple(axes)), plain.path, plain.demand, [LateDrive(1), LateDrive(2)])
    cutting(machine, 200)
    machine.receive_frames(0x000, b"\x80\x01")
    machine.run(10)
    assert machine.mode is Mode.FROZEN
    assert machine.state.undisturbed_for > 1000


@pytest.mark.fault("A19")
def test_frame_of_a_foreign_rpdo_ends_the_correction_at_once() -> None:
    machine = cutting(written_by(0x401, WRITER))
    write(machine)
    machine.run_sync()
    frames = len(machine.frames)
    assert (machine.mode, cause(machine)) == (Mode.RAMP_DOWN, ("OffsetHijack", "X"))
    machine.run(15)
    assert len(machine.frames) == frames  # until it is known what the drive holds


@pytest.mark.parametrize(
    ("period", "mode"),
    [
        pytest.param(35, Mode.FROZEN, id="before it is known what the drive holds, or in the ramp"),
        pytest.param(100, Mode.OFF, id="after the ramp"),
    ],
)
def test_guard_freezes_when_another_master_keeps_writing(period: int, mode: Mode) -> None:
    machine = cutting(written_by(WRITER))
    before = len(machine.frames)
    for _ in range(30):
        write(machine)
        machine.run(period)
    assert (machine.mode, cause(machine)) == (mode, ("OffsetHijack", "X"))
    assert len(machine.frames) - before < 100  # one ramp at most


@pytest.mark.fault("A19")
def test_foreign_offset_is_detected_by_the_read_back() -> None:
    """By an unknown COB-ID; the drive shows every second of its values."""
    machine = cutting(written_by(), 100)
    for _ in range(120):
        machine.run_sync()
        if machine.tick % PERIOD == PERIOD - 1:
            machine.drives[0].received_offset = -PITCH_ERROR
        if machine.alarms:
            break
    assert machine.alarms[0].code == "OffsetHijack"
    assert (machine.mode, machine.state.measuring > 0) == (Mode.RAMP_DOWN, True)


def test_one_unexpected_reading_is_tolerated() -> None:
    machine = cutting(written_by(), 100)
    while machine.tick % 10 != 9:
        machine.run_sync()
    machine.drives[0].received_offset = -PITCH_ERROR
    machine.run(100)
    assert machine.alarms == []


def test_arming_is_refused_next_to_another_master() -> None:
    machine = written_by(WRITER)
    machine.settle()
    write(machine, 0)
    machine.run_sync()
    assert "NotSettled" in {alarm.code for alarm in machine.arm()}


def test_arming_is_refused_with_the_reason_of_a_void_record() -> None:
    machine = bench()
    axes = machine.settings.axes
    why = "its RPDO4 (COB-ID 501) writes 60B0"
    settings = replace(machine.settings, axes=(replace(axes[0], record_void=True, void_reason=why), *axes[1:]))
    machine = Bench(decode_settings(encode_settings(settings)), machine.path, machine.demand, machine.drives)
    machine.settle()
    refused = {alarm.code: alarm.sentence() for alarm in machine.arm()}
    assert f"({why}); nothing is sent; " in refused["RecordVoid"]
    machine.reboot(0)  # a later reason is another
    machine.settle()
    assert why not in {alarm.code: alarm.sentence() for alarm in machine.arm()}["RecordVoid"]


def test_foreign_writers_are_received_and_must_not_be_our_ids() -> None:
    made = written_by(0x401, WRITER).settings
    assert decode_settings(encode_settings(made)) == made
    for ours in (0x301, 0x201, 0x181):
        axes = (replace(made.axes[0], writers=(ours,)), *made.axes[1:])
        with pytest.raises(ConfigError, match="is listed as a foreign writer's"):
            decode_settings(encode_settings(replace(made, axes=axes)))
