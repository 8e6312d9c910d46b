"""The bridge from HAL pins to a CANopen bus: samples, frames, and the cycle in which an offset takes effect."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from typing import Any

import pytest

from fdhil.bridges.hal_bus import (
    SYNC,
    SYNC_RANGE,
    AxisReader,
    HalPin,
    OffsetQueue,
    PinError,
    _require_pin,
    encode_cycle,
    get_sync_counter,
    read_axes,
)
from fdhil.config.axis_section import Drive
from fdhil.drivers.cia402.drive_profile_file import load_profile

LEAD = 20
PINS = {
    "position_command": "joint.0.motor-pos-cmd",
    "position_feedback": "encoder.0.position",
    "current": "pid.x.output",
}
VALUE = {"position_command": 10.0, "position_feedback": 9.9, "current": 2.0, "enabled": True}


def document(**hal: Any) -> dict[str, Any]:
    drive = {"source": "hal", "bus": "hal", "hal": {k: v for k, v in (PINS | hal).items() if v is not None}}
    axis = {"screw_pitch_mm": 20.0, "nominal": {"K": 0.8}, "correction": {}}
    return {"machine": {}, "axis": {"X": {**axis, "drive": drive}, "Y": {**axis, "drive": drive}, "A": {}}}


def reader(**hal: Any) -> AxisReader:
    return AxisReader(read_axes(document(**hal))[0])


def test_axes_without_hal_pins_are_ignored() -> None:
    assert [(axis.name, axis.node_id, axis.corrected) for axis in read_axes(document())] == [
        ("X", 1, True),
        ("Y", 2, True),
    ]


def test_scales_and_signs_are_applied() -> None:
    inch = reader(position_mm_per_unit=25.4, current_a_per_unit=-5.0, voltage="v", voltage_v_per_unit=24.0)
    sample = inch.read_sample({**VALUE, "voltage": 0.5, "offset": 0.001})
    assert (sample.target, sample.position) == (12_700_000, round(9.9 * 25.4 * 50_000))
    assert (sample.current, sample.voltage, sample.offset) == (-1_000_000, 600, 1270)
    torque = reader(current=None, torque="t", torque_nm_per_unit=4.0)
    assert torque.axis.pins["current"] == "t"
    assert torque.read_sample({**VALUE, "current": 1.0}).current == pytest.approx(4.0 / 0.8 * 1e5)


def test_a_missing_speed_pin_is_replaced_by_the_difference_of_positions() -> None:
    axis = reader()
    assert axis.read_sample(VALUE).speed == 0
    assert axis.read_sample({**VALUE, "position_feedback": 10.0}).speed == pytest.approx(0.1 / 0.001 * 50_000, abs=1)


def test_a_commanded_voltage_is_reported_in_the_cycle_after_it() -> None:
    axis = reader(voltage="v", voltage_is="commanded")
    assert [axis.read_sample({**VALUE, "voltage": v}).voltage for v in (1.0, 2.0, 3.0)] == [0, 50, 100]


def test_nan_value_becomes_far_out_of_range() -> None:
    assert reader().read_sample({**VALUE, "position_feedback": math.nan}).position == -(2**31)


def test_frames_match_profile_hal() -> None:
    axes = read_axes(document())
    frames = list(encode_cycle(10, axes, [AxisReader(axis).read_sample(VALUE) for axis in axes]))
    profile = load_profile(Drive.model_validate({"source": "hal", "hal": PINS}))
    lengths = {spec.cob_base + node: spec.length for spec in (*profile.rpdos, *profile.tpdos) for node in (1, 2)}
    assert [cob_id for cob_id, _ in frames][:3] == [0x201, 0x202, SYNC]
    assert all(len(data) == lengths[cob_id] for cob_id, data in frames if cob_id != SYNC)
    assert {cob_id for cob_id, _ in frames} == {*lengths, SYNC} - {0x301, 0x302}


class Streamer:
    def __init__(self) -> None:
        self.queue = OffsetQueue(read_axes(document()), LEAD)
        self.waiting: list[tuple[int, list[float]]] = []
        self.cycle, self.row, self.applied = 1000, 0, 0.0
        self.seen: dict[int, float] = {}

    def run(self, cycles: int, offset: Mapping[int, int] | None = None, late: int = 3) -> None:
        for _ in range(cycles):
            self.cycle += 1
            empty = not self.waiting
            if self.waiting:
                self.row, (self.applied, _) = self.waiting.pop(0)
            self.seen[self.cycle] = 0.0 if empty else self.applied
            self.queue.check_applied_row(self.cycle, self.row, empty)
            if offset is not None:
                answered = self.cycle - late
                increments = offset.get(answered + 1 + LEAD, 0)
                for node in (1, 2):
                    self.queue.take_offset(node, struct.pack("<iB", increments, get_sync_counter(answered)))
            self.waiting += self.queue.take_rows()


@pytest.mark.parametrize("late", [0, 1, 15])
def test_each_offset_takes_effect_in_its_own_cycle(late: int) -> None:
    wanted = {cycle: cycle % 1000 for cycle in range(1200, 1500)}
    streamer = Streamer()
    streamer.run(600, wanted, late)
    assert {c: round(streamer.seen[c] * 50_000) for c in wanted} == wanted
    assert streamer.queue.restarts == 0


def test_missing_answer_keeps_the_previous_offset() -> None:
    streamer = Streamer()
    streamer.run(200, {})
    for cycle in range(1201, 1260):
        streamer.run(1, dict.fromkeys(range(1150, 1400), 500) if cycle % 2 else None)
    assert round(streamer.applied * 50_000) == 500
    assert streamer.queue.restarts == 0


def test_streamer_restarts_aligned_after_a_silence() -> None:
    streamer = Streamer()
    streamer.run(200, {})
    streamer.run(SYNC_RANGE)  # nobody answers
    assert not streamer.waiting
    assert not streamer.queue.is_running
    wanted = dict.fromkeys(range(1600, 1700), 700)
    streamer.run(400, wanted)
    assert {c for c, mm in streamer.seen.items() if mm} == set(wanted)


FUNCTIONS = [
    ["encoder", "0", "0", "YES", "1", "encoder.update-counters"],
    ["pid", "0", "0", "YES", "0", "pid.x.do-pid-calcs"],
    ["pid", "0", "0", "YES", "1", "pid.y.do-pid-calcs"],
]
PIN_LINES = """
pid float OUT 0 pid.x.output
pid float OUT 0 pid.y.output
pid bit OUT FALSE pid.y.saturated
encoder float OUT 0 encoder.0.position ==> x-fb
odrive float OUT 0 odrive.0.iq
"""


@pytest.mark.parametrize(
    ("pin", "text"),
    [
        ("pid.z.output", "HAL has no pin pid.z.output; no component pid.z is loaded"),
        ("pid.y.outputs", "pid.y has pid.y.output"),
        ("pid.y.saturated", "is of type bit"),
        ("pid.x.output", "function pid.x.do-pid-calcs is in no thread"),
        ("odrive.0.iq", "runs in userspace"),
    ],
)
def test_invalid_pin_is_refused_with_its_key_and_name(pin: str, text: str) -> None:
    pins = {each.name: each for each in map(HalPin, PIN_LINES.splitlines()) if each.name}
    with pytest.raises(PinError, match=r"^axis\.X\.drive\.hal\.current: ") as refused:
        _require_pin(pin, pins, FUNCTIONS, "axis.X.drive.hal.current", "float")
    assert text in str(refused.value)
    for good in ("pid.y.output", "encoder.0.position"):
        _require_pin(good, pins, FUNCTIONS, "axis.X.drive.hal.current", "float")
    assert pins["encoder.0.position"].signal == "x-fb"
