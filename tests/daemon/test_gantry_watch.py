"""The monitor of the two drives of a gantry axis."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.config import parse_config
from fdhil.daemon.gantry_watch import GantryWatch
from fdhil.records import AxisSamples, freeze_array, freeze_integers
from tests.bench import rotary_and_gantry_document


def samples(axis: str, first: int, error_um: float, zero_mm: float = 0.0, rows: int = 50) -> AxisSamples:
    tick = first + np.arange(rows)
    demand = zero_mm + 0.01 * tick
    still = freeze_array(np.zeros(rows))
    return AxisSamples(
        axis=axis, tick=freeze_integers(tick), demand_mm=freeze_array(demand),
        position_mm=freeze_array(demand - 1e-3 * error_um), offset_mm=still,
        speed_rad_s=still, current_a=still, voltage_v=None, statusword=freeze_integers(np.zeros(rows)),
    )  # fmt: skip


@pytest.fixture
def watch() -> GantryWatch:
    return GantryWatch(parse_config(rotary_and_gantry_document()))


def test_equal_lag_of_both_drives_is_not_a_skew(watch: GantryWatch) -> None:
    watch.take_samples(samples("Y", 0, 900.0))
    watch.take_samples(samples("Y2", 0, 880.0, zero_mm=250.0))
    assert watch.check_skew() == (False, [])


def test_skew_is_reported_once_while_it_lasts(watch: GantryWatch) -> None:
    for first, reported in ((0, 1), (50, 0), (100, 0)):
        watch.take_samples(samples("Y", first, 20.0))
        watch.take_samples(samples("Y2", first, 620.0))
        skewed, notices = watch.check_skew()
        assert skewed
        assert [(n.code, n.severity, n.axis, n.text) for n in notices] == reported * [
            ("GantrySkew", "MAJOR", "Y", "the drives Y and Y2 are 600 um apart, 500 are allowed")
        ]
    watch.take_samples(samples("Y", 150, 20.0))
    watch.take_samples(samples("Y2", 150, 30.0))
    skewed, notices = watch.check_skew()
    assert not skewed
    assert [(notice.code, notice.severity, notice.axis) for notice in notices] == [("GantrySkew", "info", "Y")]
    assert watch.check_skew() == (False, [])


def test_only_the_same_sync_is_compared(watch: GantryWatch) -> None:
    watch.take_samples(samples("Y", 0, 0.0))
    watch.take_samples(samples("Y2", 50, 900.0))
    watch.take_samples(samples("X", 0, 0.0))
    assert watch.check_skew() == (False, [])
    watch.take_samples(samples("Y", 50, 880.0))
    assert watch.check_skew() == (False, [])


def test_restarted_sync_count_is_followed(watch: GantryWatch) -> None:
    for first in (5000, 0):
        watch.take_samples(samples("Y", first, 0.0))
        watch.take_samples(samples("Y2", first, 700.0))
        assert watch.check_skew()[0]


def test_missing_samples_are_not_a_skew(watch: GantryWatch) -> None:
    watch.take_samples(samples("Y", 0, float("nan")))
    watch.take_samples(samples("Y2", 0, 0.0))
    assert watch.check_skew() == (False, [])
