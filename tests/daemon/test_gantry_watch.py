"""The monitor of the two drives of a gantry axis."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.config import parse
from fdhil.daemon.gantry_watch import GantryWatch
from fdhil.records import AxisSamples, frozen, frozen_ints
from tests.bench import rotary_and_gantry_document


def samples(axis: str, first: int, error_um: float, zero_mm: float = 0.0, rows: int = 50) -> AxisSamples:
    tick = first + np.arange(rows)
    demand = zero_mm + 0.01 * tick
    still = frozen(np.zeros(rows))
    return AxisSamples(
        axis=axis, tick=frozen_ints(tick), demand_mm=frozen(demand), position_mm=frozen(demand - 1e-3 * error_um),
        offset_mm=still, speed_rad_s=still, current_a=still, voltage_v=None, statusword=frozen_ints(np.zeros(rows)),
    )  # fmt: skip


@pytest.fixture
def watch() -> GantryWatch:
    return GantryWatch(parse(rotary_and_gantry_document()))


def test_equal_lag_of_both_drives_is_no_skew_and_zeros_may_differ(watch: GantryWatch) -> None:
    watch.feed(samples("Y", 0, 900.0))
    watch.feed(samples("Y2", 0, 880.0, zero_mm=250.0))
    assert watch.look() == (False, [])


def test_skew_is_reported_once_and_counts_as_long_as_it_lasts(watch: GantryWatch) -> None:
    for first, reported in ((0, 1), (50, 0), (100, 0)):
        watch.feed(samples("Y", first, 20.0))
        watch.feed(samples("Y2", first, 620.0))
        skewed, notices = watch.look()
        assert skewed
        assert [(n.code, n.severity, n.axis, n.text) for n in notices] == reported * [
            ("GantrySkew", "MAJOR", "Y", "the drives Y and Y2 are 600 um apart, 500 are allowed")
        ]
    watch.feed(samples("Y", 150, 20.0))
    watch.feed(samples("Y2", 150, 30.0))
    skewed, notices = watch.look()
    assert not skewed
    assert [(notice.code, notice.severity, notice.axis) for notice in notices] == [("GantrySkew", "info", "Y")]
    assert watch.look() == (False, [])


def test_only_the_same_sync_is_compared(watch: GantryWatch) -> None:
    watch.feed(samples("Y", 0, 0.0))
    watch.feed(samples("Y2", 50, 900.0))
    watch.feed(samples("X", 0, 0.0))
    assert watch.look() == (False, [])
    watch.feed(samples("Y", 50, 880.0))
    assert watch.look() == (False, [])


def test_sync_count_that_begins_again_is_followed(watch: GantryWatch) -> None:
    for first in (5000, 0):
        watch.feed(samples("Y", first, 0.0))
        watch.feed(samples("Y2", first, 700.0))
        assert watch.look()[0]


def test_missing_samples_are_no_skew(watch: GantryWatch) -> None:
    watch.feed(samples("Y", 0, float("nan")))
    watch.feed(samples("Y2", 0, 0.0))
    assert watch.look() == (False, [])
