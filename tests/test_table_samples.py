"""Samples of sensors at the table are placed on the rows of the drive's samples, or dropped."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.pipeline.table_samples import Motion, RecentTable
from fdhil.records import Float, TableSamples, TableSignal, freeze_array

N, START = 200, 1000
SPEED = 0.5  # mm a tick


def motion(speed: float = SPEED) -> Motion:
    return Motion(START, freeze_array(speed * np.arange(N)), np.full(N, speed))


def said(signal: TableSignal, tick: Float, values: Float, error: float = 0.0, rate: float = 1.0) -> TableSamples:
    return TableSamples("X", signal, freeze_array(tick), error, freeze_array(values), rate)


def test_places_at_their_sync_are_taken_as_they_are() -> None:
    table, tick = RecentTable(10_000), np.arange(START - 5, START + N + 5)
    table.add(said("table_mm", np.delete(tick, 50), np.delete(tick * 0.1, 50)))
    places = table.places(motion())
    assert places is not None
    assert np.flatnonzero(np.isnan(places)).tolist() == [45]
    assert np.allclose(np.delete(places, 45), np.delete(tick[5:-5] * 0.1, 45))


def test_a_place_between_two_rows_counts_less_what_the_motor_went() -> None:
    table = RecentTable(10_000)
    table.add(said("table_mm", np.array([START + 20.3]), np.array([20.3 * SPEED + 0.007])))
    places = table.places(motion())
    assert places is not None
    assert places[20] == pytest.approx(20 * SPEED + 0.007)
    assert np.isnan(np.delete(places, 20)).all()


@pytest.mark.parametrize(("speed", "kept"), [(0.5, False), (1e-3, True), (0.0, True)])
def test_a_place_that_came_at_an_unsure_instant_counts_where_the_table_stands(speed: float, kept: bool) -> None:
    table = RecentTable(10_000)
    table.add(said("table_mm", np.array([START + 20.4]), np.array([3.0]), error=1.5))
    assert (table.places(motion(speed)) is not None) == kept


@pytest.mark.parametrize("rate", [0.8, 0.5, 3.2])
def test_accelerations_between_the_rows_are_interpolated_or_averaged(rate: float) -> None:
    tick = np.arange(START - 20.0, START + N + 20.0, 1 / rate) + 0.37
    wave = np.sin(2 * np.pi * 0.06 * tick)  # 60 Hz of rows of 1 ms
    table = RecentTable(10_000)
    for part in np.array_split(np.arange(tick.size), 7):
        table.add(said("table_m_s2", tick[part], wave[part], rate=rate))
    values = table.accelerations(motion())
    assert values is not None
    assert np.abs(values - np.sin(2 * np.pi * 0.06 * (START + np.arange(N)))).max() < 0.06


def test_over_a_lost_acceleration_nothing_is_told() -> None:
    tick = np.arange(START - 20.0, START + N + 20.0, 1.25)
    table = RecentTable(10_000)
    table.add(said("table_m_s2", np.delete(tick, 60), np.ones(tick.size - 1), rate=0.8))
    values = table.accelerations(motion())
    assert values is not None
    lost = np.flatnonzero(np.isnan(values))
    assert lost.size in range(2, 8)
    assert np.allclose(np.delete(values, lost), 1.0)


def test_what_is_old_is_let_go_and_a_count_that_fell_begins_anew() -> None:
    table = RecentTable(100)
    table.add(said("table_mm", np.arange(0.0, 50.0), np.zeros(50)))
    table.add(said("table_mm", np.arange(1000.0, 1100.0), np.ones(100)))
    places = table.places(Motion(0, np.zeros(1100), np.zeros(1100)))
    assert places is not None
    assert np.isnan(places[:50]).all()
    table.add(said("table_mm", np.arange(0.0, 10.0), np.ones(10)))
    again = table.places(Motion(0, np.zeros(1100), np.zeros(1100)))
    assert again is not None
    assert np.isnan(again[1000:]).all()
    assert table.accelerations(motion()) is None
    table.clear()
    assert table.places(motion()) is None
