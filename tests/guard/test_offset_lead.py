"""Offsets that wait in a queue (HAL's streamer): sent ahead, in force at their own row, read back with that delay."""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field, replace

import pytest

from fdhil.config.offset_bounds import TIME_TO_SAFE_S
from fdhil.errors import ConfigError
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_settings import LEAD_LAYOUT, AxisSettings, Pdo, decode_settings, encode_settings
from fdhil.guard.offset_adoption import count_cycles_to_wait
from tests.guard.simulated_bus import Bench, Drive, bench, settings

LEAD = 20


@dataclass
class QueuedDrive(Drive):
    waiting: deque[int] = field(default_factory=lambda: deque([0] * LEAD))
    empty: bool = False

    def at_sync(self, tick: int) -> list[tuple[int, bytes]]:
        received = self.received_offset if self.received_offset is not None else self.waiting[-1]
        self.waiting.append(received)
        self.received_offset = 0 if self.empty else self.waiting[0]
        self.waiting.popleft()
        frames = [frame for frame in super().at_sync(tick) if frame[0] & 0x780 != 0x380]
        return [*frames, (0x380 + self.node_id, struct.pack("<ii", self.followed or 0, self.offset))]


def ahead(axis: AxisSettings) -> AxisSettings:
    tpdos = tuple(replace(pdo, every_sync=1) if pdo.cob_id & 0x780 == 0x380 else pdo for pdo in axis.tpdos)
    offset = Pdo(axis.offset.cob_id, LEAD_LAYOUT)
    return replace(axis, offset=offset, tpdos=tpdos)


@pytest.fixture
def armed_machine() -> Bench:
    machine = bench(lead=LEAD)
    axes = tuple(ahead(axis) for axis in machine.settings.axes)
    drives = [QueuedDrive(drive.node_id, queue=drive.queue) for drive in machine.drives]
    machine = Bench(replace(machine.settings, axes=axes), machine.path, machine.demand, list(drives))
    machine.settle(200)
    assert machine.arm() == ()
    machine.run(30)
    return machine


def test_offsets_with_a_lead_act_at_their_own_rows(armed_machine: Bench) -> None:
    assert armed_machine.path is not None
    armed_machine.play()
    latched: list[tuple[int, int]] = []
    for _ in range(560):
        armed_machine.run_sync()
        latched.append((armed_machine.drives[0].target, armed_machine.drives[0].offset))
    demand, offset = armed_machine.path.demand[0], armed_machine.path.offset[0]
    rows = {target: k for k, target in enumerate(demand)}
    moving = [(target, held) for target, held in latched if demand[40 + 2 * LEAD] < target < demand[-60]]
    assert len(moving) > 400
    assert all(held == offset[rows[target]] for target, held in moving)
    armed_machine.run(200)
    assert armed_machine.mode is Mode.OFF
    assert [drive.offset for drive in armed_machine.drives] == [0, 0]


def test_empty_queue_is_detected_and_ramped_down(armed_machine: Bench) -> None:
    armed_machine.play()
    armed_machine.run_until(Mode.ACTIVE)
    armed_machine.run(100)
    for drive in armed_machine.drives:
        assert isinstance(drive, QueuedDrive)
        drive.empty = True
    armed_machine.run_until(Mode.RAMP_DOWN, limit=10)
    assert armed_machine.alarms[-1].code in ("EchoMismatch", "OffsetHijack")
    armed_machine.run_until(Mode.OFF, limit=600)
    assert [drive.offset for drive in armed_machine.drives] == [0, 0]


def test_adoption_waits_until_hal_has_ramped_the_offset() -> None:
    made = settings(lead=LEAD)
    made = replace(made, axes=tuple(map(ahead, made.axes)))
    assert count_cycles_to_wait(made) * made.sync_period_s > TIME_TO_SAFE_S + LEAD * made.sync_period_s


@pytest.mark.parametrize("changes", [{"lead": -1}, {"lead": 201}, {"lead": 0}])
def test_lead_without_its_layout_or_out_of_range_is_refused(changes: dict[str, int]) -> None:
    made = settings(**changes)  # type: ignore[arg-type] # a field of Settings
    made = replace(made, axes=tuple(map(ahead, made.axes)))
    with pytest.raises(ConfigError):
        decode_settings(encode_settings(made))


def test_settings_with_a_lead_survive_the_file() -> None:
    made = settings(lead=LEAD)
    made = replace(made, axes=tuple(map(ahead, made.axes)))
    assert decode_settings(encode_settings(made)) == made
