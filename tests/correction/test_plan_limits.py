"""The limits of an offset: the check against plain arithmetic, and plans that keep every limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil.correction import PlanLimits, check_offsets
from fdhil.correction.plan_limits import compute_variation, fit_within_limits, round_to_increments
from tests.bench import bench_config

AXIS = bench_config("X").axis["X"]
BENCH = PlanLimits.derive(AXIS, 0.001)
NARROW = PlanLimits(160.0, 6.5, 0.82, 9830.0, 1000, 0.305)  # 50 um, 2 mm/s, 250 mm/s2


def test_limits_follow_from_configuration_and_axis() -> None:
    assert pytest.approx(250.0 / BENCH.um_per_increment) == BENCH.offset
    assert pytest.approx(20.0 / BENCH.um_per_increment) == BENCH.rate
    slow = AXIS.model_copy(update={"rapid_speed_mm_s": 100.0, "max_acceleration_mm_s2": 1000.0})
    assert PlanLimits.derive(slow, 0.001).rate == 20.0  # of 10 mm/s; with 500 mm/s2 that is what can be braked in 20 ms
    assert pytest.approx(0.5 / BENCH.um_per_increment) == PlanLimits.derive(slow, 0.001).acceleration
    with pytest.raises(ValueError, match="off"):
        PlanLimits.derive(AXIS.model_copy(update={"correction": None}), 0.001)


@pytest.mark.parametrize(
    ("offsets", "code"),
    [
        (np.zeros(5), None),
        (np.full(3, 200.0), "OffsetRate"),  # from 0 at once
        (np.cumsum(np.minimum(np.arange(60) * 6, 60)), "OffsetLimit"),
        (np.minimum(np.cumsum(np.minimum(np.arange(30) * 6, 60)), 800), "OffsetLimit"),  # cannot brake in time
        (np.array([0, 6, 18, 60, 70]), "OffsetRate"),
        (60 * np.abs(((np.arange(3000) // 10) % 2) * 10 - np.arange(3000) % 10), None),
    ],
)
def test_check_names_violated_limit(offsets: np.ndarray[tuple[int], np.dtype[np.float64]], code: str | None) -> None:
    codes = [reason.code for reason in check_offsets(offsets.astype(np.int64), BENCH)]
    if code is None and offsets.max() > 100:
        assert "OffsetEnergy" in codes
    else:
        assert code in codes if code else not codes


def test_variation_covers_last_second() -> None:
    rate = np.random.default_rng(1).normal(0, 3, 500)
    expected = [np.abs(rate[max(0, k - 99) : k + 1]).sum() for k in range(500)]
    assert np.allclose(compute_variation(rate, 100), expected)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.1, 2000), st.floats(1, 300), st.booleans())
def test_planned_offset_passes_check(seed: int, amplitude: float, period: float, narrow: bool) -> None:
    random = np.random.default_rng(seed)
    rows = np.arange(random.integers(3, 1500))
    wanted = amplitude * (np.sin(rows * 2 * np.pi / period) + random.normal(0, 0.1, rows.size))
    wanted[rows.size // 2 :] += amplitude * random.choice([-1.0, 0.0, 1.0])
    limits = NARROW if narrow else BENCH
    assert check_offsets(round_to_increments(fit_within_limits(wanted, limits)), limits) == []


def test_feasible_offset_is_unchanged() -> None:
    wanted = 300 * np.sin(np.arange(2000) * 2 * np.pi / 400) ** 2
    assert np.array_equal(fit_within_limits(wanted, BENCH), wanted)


def test_planned_offset_is_nearest_feasible() -> None:
    random = np.random.default_rng(3)
    wanted = 200 * np.sign(np.sin(np.arange(400) * 2 * np.pi / 200 - 0.5)) + random.normal(0, 2, 400)
    planned = fit_within_limits(wanted, BENCH)
    distance = float(((planned - wanted) ** 2).sum())
    inside = replace(BENCH.curve_limits, variation=np.inf)
    nearer = 0
    for _ in range(300):
        bump = random.normal(0, 1, 400) * np.exp(-(((np.arange(400) - random.integers(400)) / 20.0) ** 2))
        bump = np.convolve(bump, np.hanning(25) / 12, mode="same")
        other = planned + 0.5 * bump / np.abs(bump).max()
        rate = np.diff(other, prepend=0.0)
        feasible = (
            np.abs(other).max() <= inside.offset
            and np.abs(rate).max() <= inside.rate
            and np.abs(np.diff(rate, prepend=0.0)).max() <= inside.acceleration
        )
        nearer += feasible and ((other - wanted) ** 2).sum() < distance - 1e-3
    assert nearer == 0


def test_continued_plan_keeps_limits_at_seam() -> None:
    first = round_to_increments(fit_within_limits(150 * np.sin(np.arange(500) / 30.0) ** 2, BENCH))
    before = (float(first[-1]), float(first[-2]))
    second = round_to_increments(fit_within_limits(np.full(400, -200.0), BENCH, before))
    assert check_offsets(second, BENCH, before) == []
    assert check_offsets(np.concatenate([first, second]), BENCH) == []
