"""Samples of sensors at the table are placed on the rows of the drive's samples, or dropped."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.pipeline.table_sample_buffer import MotorMotion, TableSampleBuffer
from fdhil.records import Float, TableSamples, TableSignal, freeze_array

N, START = 200, 1000
SPEED = 0.5  # mm a tick


def make_motion(speed: float = SPEED) -> MotorMotion:
    return MotorMotion(START, freeze_array(speed * np.arange(N)), np.full(N, speed))


def make_samples(
    signal: TableSignal, tick: Float, values: Float, error: float = 0.0, rate: float = 1.0
) -> TableSamples:
    return TableSamples("X", signal, freeze_array(tick), error, freeze_array(values), rate)


def test_positions_at_sync_are_unchanged() -> None:
    table, tick = TableSampleBuffer(10_000), np.arange(START - 5, START + N + 5)
    table.append_block(make_samples("table_mm", np.delete(tick, 50), np.delete(tick * 0.1, 50)))
    places = table.place_positions(make_motion())
    assert places is not None
    assert np.flatnonzero(np.isnan(places)).tolist() == [45]
    assert np.allclose(np.delete(places, 45), np.delete(tick[5:-5] * 0.1, 45))


def test_position_between_rows_is_shifted_by_motor_travel() -> None:
    table = TableSampleBuffer(10_000)
    table.append_block(make_samples("table_mm", np.array([START + 20.3]), np.array([20.3 * SPEED + 0.007])))
    places = table.place_positions(make_motion())
    assert places is not None
    assert places[20] == pytest.approx(20 * SPEED + 0.007)
    assert np.isnan(np.delete(places, 20)).all()


@pytest.mark.parametrize(("speed", "kept"), [(0.5, False), (1e-3, True), (0.0, True)])
def test_position_of_uncertain_instant_counts_at_standstill(speed: float, kept: bool) -> None:
    table = TableSampleBuffer(10_000)
    table.append_block(make_samples("table_mm", np.array([START + 20.4]), np.array([3.0]), error=1.5))
    assert (table.place_positions(make_motion(speed)) is not None) == kept


@pytest.mark.parametrize("rate", [0.8, 0.5, 3.2])
def test_accelerations_are_interpolated_or_averaged(rate: float) -> None:
    tick = np.arange(START - 20.0, START + N + 20.0, 1 / rate) + 0.37
    wave = np.sin(2 * np.pi * 0.06 * tick)  # 60 Hz of rows of 1 ms
    table = TableSampleBuffer(10_000)
    for part in np.array_split(np.arange(tick.size), 7):
        table.append_block(make_samples("table_m_s2", tick[part], wave[part], rate=rate))
    values = table.resample_accelerations(make_motion())
    assert values is not None
    assert np.abs(values - np.sin(2 * np.pi * 0.06 * (START + np.arange(N)))).max() < 0.06


def test_lost_acceleration_gives_nan() -> None:
    tick = np.arange(START - 20.0, START + N + 20.0, 1.25)
    table = TableSampleBuffer(10_000)
    table.append_block(make_samples("table_m_s2", np.delete(tick, 60), np.ones(tick.size - 1), rate=0.8))
    values = table.resample_accelerations(make_motion())
    assert values is not None
    lost = np.flatnonzero(np.isnan(values))
    assert lost.size in range(2, 8)
    assert np.allclose(np.delete(values, lost), 1.0)


def test_old_samples_are_dropped_and_lower_count_restarts() -> None:
    table = TableSampleBuffer(100)
    table.append_block(make_samples("table_mm", np.arange(0.0, 50.0), np.zeros(50)))
    table.append_block(make_samples("table_mm", np.arange(1000.0, 1100.0), np.ones(100)))
    places = table.place_positions(MotorMotion(0, np.zeros(1100), np.zeros(1100)))
    assert places is not None
    assert np.isnan(places[:50]).all()
    table.append_block(make_samples("table_mm", np.arange(0.0, 10.0), np.ones(10)))
    again = table.place_positions(MotorMotion(0, np.zeros(1100), np.zeros(1100)))
    assert again is not None
    assert np.isnan(again[1000:]).all()
    assert table.resample_accelerations(make_motion()) is None
    table.clear()
    assert table.place_positions(make_motion()) is None
