"""The table of checks and the false-alarm budget behind their thresholds are consistent."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators.maximum_likelihood import fit_windows
from fdhil.pipeline import analyse_window
from fdhil.records import Reason
from fdhil.validation.estimate_agreement import find_deviating_values
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.window_checks import FIT_CHECKS, SIGNAL_CHECKS, Check, run_checks
from fdhil.validation.window_signals import WindowSignals
from tests.identification.bench_recordings import find_noisy_windows

SETTINGS = Identification()


def test_skip_conditions_name_earlier_checks() -> None:
    before: list[str] = []
    checks: tuple[Check[Any], ...] = (*SIGNAL_CHECKS, *FIT_CHECKS)
    for check in checks:
        assert set(check.unless) <= set(before)
        assert check.name not in before
        before.append(check.name)


def test_explained_check_is_skipped() -> None:
    reason = Reason("Implausible", "first")
    first: Check[WindowSignals] = Check("first", lambda _: [reason])
    second: Check[WindowSignals] = Check("second", lambda _: [reason], unless=("first",))
    signals = WindowSignals(find_noisy_windows(0.002)[0], SETTINGS)
    assert run_checks([first, second], signals, {}) == {"first": [reason]}
    assert run_checks([second], signals, {"first": []}) == {"first": [], "second": [reason]}


def test_false_alarm_budget_yields_every_threshold() -> None:
    assert sum(share.share for share in BUDGET.values()) <= 1.0
    deviations = {"structure": 4.5, "timing": 4.5, "play": 4.5, "whiteness": 5.0, "between windows": 5.0}
    for name, reported in (deviations | {"standstill": 5.5, "position": 6.0, "data sheet": 3.0}).items():
        assert BUDGET[name].deviations == pytest.approx(reported, abs=0.02)
    for name, chance in {"stuck": 2e-3, "saturated": 1e-4, "slow voltage": 1e-5, "cut off": 1e-6}.items():
        assert BUDGET[name].chance == pytest.approx(chance)


@pytest.mark.parametrize("method", ["least_squares", "partial_moments", "maximum_likelihood"])
def test_deviating_value_is_refused_by_method_intervals(method: str) -> None:
    window = find_noisy_windows(0.002)[0]
    outcome, fit = analyse_window(window, Identification(method=method)), fit_windows([window], SETTINGS)
    assert outcome.verdict.accepted
    assert outcome.estimate is not None
    assert fit is not None
    assert list(find_deviating_values(outcome.estimate, fit.theta[:6])) == []
    off = replace(outcome.estimate, values=outcome.estimate.values * np.array([1.0, 1.0, 1.1, 1.0, 1.0, 1.0]))
    (reason,) = find_deviating_values(off, fit.theta[:6])
    assert reason.text.startswith("K = ")
    assert method in reason.text
