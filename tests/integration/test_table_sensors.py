"""What a motor encoder cannot see: table encoder and accelerometer show the resonance on the screw.

The simulator is stepped directly, and its frames pass drivers and pipeline with given arrival times: the same bits each
time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.drivers.can.frame_ring import pack_frames
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.drivers.serial.text_lines import TextLine
from fdhil.drivers.table.accelerometer import StreamedAccelerometer
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window
from fdhil.pipeline.sample_buffer import SampleBuffer
from fdhil.records import AxisSamples, Estimate, TableSamples, TickTimes, WindowOutcome
from fdhil.sim.frame_types import Frame
from tests.bench import bench_document
from tests.sim.bench_simulator import SteppedSimulator, smooth_rows

TRUE = {"X": 80.0, "Y": 60.0}  # Hz
PERIOD_S, PERIOD_NS = 1e-3, 1_000_000
DRAIN_CYCLES, LATE_NS = 50, 400_000  # how often what came is taken, and how late what came is stamped


def config() -> MachineConfig:
    document: dict[str, Any] = bench_document()
    document["axis"]["X"]["table"] = {"source": "canopen", "cob_id": 0x2A0, "byte": 2, "scale": 1e-4}
    document["axis"]["Y"]["accelerometer"] = {"device": "/dev/none", "rate_hz": 800.0}
    reality = {axis: {"reality": {"resonance_hz": hz, "position_encoder": "motor"}} for axis, hz in TRUE.items()}
    document["sim"] = {"modbus": False, "axis": reality}
    return machine_config.parse_config(document)


def move_back_and_forth() -> np.ndarray[Any, Any]:
    t = np.arange(0.0, 1.2, PERIOD_S)
    way = np.cumsum(np.clip(np.minimum(t * 4000, (0.725 - t) * 4000), 0, 500)) * PERIOD_S
    both = np.concatenate([np.zeros(200), way, way[-1] - way])
    return smooth_rows(np.column_stack([both, both]), (20, 10))


def cycles(hand: SteppedSimulator) -> Iterator[list[Frame]]:
    while not any(event["event"] == "finished" for event in hand.events):
        known = len(hand.wire)
        hand.run_cycles(1)
        yield hand.wire[known:]


@cache
def recorded() -> dict[str, list[WindowOutcome]]:
    machine, begun = config(), 0
    decoder, ticks = BusDecoder("can0", machine), TickClock(PERIOD_S)
    settings = machine.axis["Y"].accelerometer
    assert settings is not None
    sensor = StreamedAccelerometer("Y", settings, PERIOD_S)
    recent = {axis: SampleBuffer(axis, section, 10_000, PERIOD_S) for axis, section in machine.axis.items()}
    hand = SteppedSimulator(machine)
    hand.switch_on()
    hand.play_rows(move_back_and_forth())
    hand.machine.tables.accelerometers["Y"].take_lines()
    frames: list[tuple[int, int, bytes]] = []
    lines: list[TextLine] = []
    for k, sent in enumerate(cycles(hand)):
        now_ns = k * PERIOD_NS
        frames += [(now_ns + 1000 * place, can_id, data) for place, (can_id, data) in enumerate(sent)]
        came = hand.machine.tables.accelerometers["Y"].take_lines().decode().splitlines()
        lines += [TextLine(line, now_ns + LATE_NS) for line in came]
        if k % DRAIN_CYCLES:
            continue
        for record in (*decoder.decode_frames(pack_frames(frames), now_ns), *sensor.accept_lines(lines, ticks)):
            if isinstance(record, TickTimes):
                ticks.add_arrivals(record)
            if isinstance(record, AxisSamples | TableSamples):
                recent[record.axis].append_block(record)
        frames, lines = [], []
    outcomes = {}
    for axis, section in machine.axis.items():
        windows = find_windows(
            recent[axis].extract_recording(begun, recent[axis].newest_tick or 0), section.rapid_speed_rad_s
        )
        outcomes[axis] = [analyse_window(window, machine.identification, section, PERIOD_S) for window in windows]
    return outcomes


def estimates(axis: str) -> list[Estimate]:
    return [o.estimate for o in recorded()[axis] if o.estimate is not None and "resonance" in o.estimate.terms]


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("axis", list(TRUE))
def test_resonance_is_found_and_each_rapid_accepted(axis: str) -> None:
    assert [o.window.direction for o in recorded()[axis]] == [1, -1]
    assert [o.verdict.accepted for o in recorded()[axis]] == [True, True], [o.verdict for o in recorded()[axis]]
    assert len(estimates(axis)) == 2
    for estimate in estimates(axis):
        assert abs(estimate.get_value("resonance") - TRUE[axis]) < 3 * estimate.get_std("resonance")
        assert estimate.get_value("resonance") == pytest.approx(TRUE[axis], rel=0.1)
        assert abs(estimate.get_value("resonance_damping") - 0.02) < 4 * estimate.get_std("resonance_damping")


@pytest.mark.usefixtures("long_computation")
def test_model_with_resonance_predicts_what_the_motor_encoder_misses() -> None:
    for result in (o.at_table for o in recorded()["X"]):
        assert result is not None
        assert result.unseen_rms_um > 15.0
        assert result.left_rms_um is not None
        assert result.left_rms_um < result.unseen_rms_um / 4
    assert all(o.at_table is None for o in recorded()["Y"])  # it has no encoder


@pytest.mark.usefixtures("long_computation")
def test_each_sensor_signal_is_aligned_with_the_drives_samples() -> None:
    for axis, name in (("X", "table_mm"), ("Y", "table_m_s2")):
        for outcome in recorded()[axis]:
            values = getattr(outcome.window, name)
            assert values is not None
            assert np.isfinite(values).mean() > 0.99
