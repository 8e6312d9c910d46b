"""Offsets that wait in a queue (HAL's streamer): sent ahead, in force at their own row, read back with that delay."""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field, replace

import pytest

from fdhil.config.offset_bounds import TIME_TO_SAFE_S
from fdhil.errors import ConfigError
from fdhil.guard.adoption import patience
from fdhil.guard.protocol import Mode
from fdhil.guard.settings import LEAD_LAYOUT, AxisSettings, Pdo, from_json, to_json
from tests.guard.machine import Bench, Drive, bench, settings

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
def armed() -> Bench:
    machine = bench(lead=LEAD)
    axes = tuple(ahead(axis) for axis in machine.settings.axes)
    drives = [QueuedDrive(drive.node_id, queue=drive.queue) for drive in machine.drives]
    machine = Bench(replace(machine.settings, axes=axes), machine.path, machine.demand, list(drives))
    machine.settle(200)
    assert machine.arm() == ()
    machine.run(30)
    return machine


def test_offsets_are_in_force_at_their_own_rows(armed: Bench) -> None:
    assert armed.path is not None
    armed.play()
    latched: list[tuple[int, int]] = []
    for _ in range(560):
        armed.sync()
        latched.append((armed.drives[0].target, armed.drives[0].offset))
    demand, offset = armed.path.demand[0], armed.path.offset[0]
    rows = {target: k for k, target in enumerate(demand)}
    moving = [(target, held) for target, held in latched if demand[40 + 2 * LEAD] < target < demand[-60]]
    assert len(moving) > 400
    assert all(held == offset[rows[target]] for target, held in moving)
    armed.run(200)
    assert armed.mode is Mode.OFF
    assert [drive.offset for drive in armed.drives] == [0, 0]


def test_a_queue_that_runs_empty_is_seen_and_ramped_down(armed: Bench) -> None:
    armed.play()
    armed.until(Mode.ACTIVE)
    armed.run(100)
    for drive in armed.drives:
        assert isinstance(drive, QueuedDrive)
        drive.empty = True
    armed.until(Mode.RAMP_DOWN, limit=10)
    assert armed.alarms[-1].code in ("EchoMismatch", "OffsetHijack")
    armed.until(Mode.OFF, limit=600)
    assert [drive.offset for drive in armed.drives] == [0, 0]


def test_an_offset_that_hal_takes_to_zero_is_awaited_before_it_is_judged() -> None:
    made = settings(lead=LEAD)
    made = replace(made, axes=tuple(map(ahead, made.axes)))
    assert patience(made) * made.sync_period_s > TIME_TO_SAFE_S + LEAD * made.sync_period_s


@pytest.mark.parametrize("changes", [{"lead": -1}, {"lead": 201}, {"lead": 0}])
def test_a_lead_without_its_layout_or_out_of_range_is_refused(changes: dict[str, int]) -> None:
    made = settings(**changes)  # type: ignore[arg-type] # a field of Settings
    made = replace(made, axes=tuple(map(ahead, made.axes)))
    with pytest.raises(ConfigError):
        from_json(to_json(made))


def test_settings_with_a_lead_are_read_back() -> None:
    made = settings(lead=LEAD)
    made = replace(made, axes=tuple(map(ahead, made.axes)))
    assert from_json(to_json(made)) == made
