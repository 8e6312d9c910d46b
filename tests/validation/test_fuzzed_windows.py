"""Any data gives a result or a reason: never an exception, never a parameter without its interval."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fdhil import tables
from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Float, Window, WindowOutcome, freeze_array
from tests.identification.bench_recordings import find_noisy_windows, record_noisy_shuttle

FIELDS = ("voltage_v", "current_a", "speed_rad_s", "position_mm")
EXTREMES = [0.0, 1e-300, 1e-12, 1e6, 1e300, -1e300, np.nan, np.inf, -np.inf]


def assert_verdict_with_reasons(outcome: WindowOutcome) -> None:
    assert outcome.verdict.accepted == (not outcome.verdict.reasons)
    assert outcome.estimate is not None
    for name in outcome.estimate.names:
        value, std = outcome.estimate.get_value(name), outcome.estimate.get_std(name)
        if np.isfinite(value):
            assert np.isfinite(std)
            assert std >= 0
        else:
            assert outcome.verdict.reasons
    assert all(reason.code and reason.text for reason in outcome.verdict.reasons)


def _corrupt_window(window: Window, name: str, start: int, length: int, value: float, scale: float) -> Window:
    values: Float = np.array(getattr(window, name)) * scale
    values[start : start + length] = value
    fields = {field: getattr(window, field) for field in window.__slots__} | {name: freeze_array(values)}
    return Window(**fields)


@settings(max_examples=15, deadline=None)
@given(
    name=st.sampled_from(FIELDS),
    start=st.integers(0, 1090),
    length=st.integers(0, 1100),
    value=st.one_of(st.sampled_from(EXTREMES), st.floats(-1e4, 1e4)),
    scale=st.sampled_from([1.0, -1.0, 0.0, 1e-9, 1e9]),
    method=st.sampled_from(list(tables.ESTIMATORS)),
)
def test_corrupt_window_gets_verdict(
    name: str, start: int, length: int, value: float, scale: float, method: str
) -> None:
    corrupted = _corrupt_window(find_noisy_windows(0.003)[0], name, start, length, value, scale)
    chosen = Identification(method=method)
    outcome = analyse_window(corrupted, chosen)
    assert_verdict_with_reasons(outcome)
    pool_windows([outcome], chosen)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 400), size=st.sampled_from([0.0, 1e-6, 1.0, 1e5]))
def test_noise_without_move_gets_verdict(seed: int, rows: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    whole = record_noisy_shuttle(0.0)
    signals = [freeze_array(size * rng.standard_normal(rows)) for _ in range(5)]
    silent = replace(
        whole,
        time_s=whole.time_s[:rows],
        voltage_v=signals[0],
        current_a=signals[1],
        speed_rad_s=signals[2],
        position_mm=signals[3],
        demand_mm=signals[4],
        rapid_speed_rad_s=None,
    )
    outcomes = [analyse_window(window, Identification()) for window in find_windows(silent)]
    for outcome in outcomes:
        assert_verdict_with_reasons(outcome)
    _, verdict = pool_windows(outcomes, Identification())
    assert verdict.accepted or verdict.reasons


def test_short_window_gets_verdict() -> None:
    window = find_noisy_windows(0.003)[0]
    for rows in (0, 1, 3, 31, 40, 120):
        arrays = {name: freeze_array(np.array(getattr(window, name))[:rows]) for name in (*FIELDS, "demand_mm")}
        short = Window(**{f: getattr(window, f) for f in window.__slots__} | arrays)
        assert_verdict_with_reasons(analyse_window(short, Identification()))


def test_window_without_valid_samples_gets_verdict() -> None:
    window = find_noisy_windows(0.003)[0]
    nothing = freeze_array(np.full(window.n, np.nan))
    lost = Window(
        **{f: getattr(window, f) for f in window.__slots__}
        | dict.fromkeys((*FIELDS, "demand_mm"), nothing)
        | {"gaps": ((0, window.n),)}
    )
    outcome = analyse_window(lost, Identification())
    assert_verdict_with_reasons(outcome)
    assert "StaleData" in [reason.code for reason in outcome.verdict.reasons]
