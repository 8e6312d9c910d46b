"""Undetermined parameters are null with a reason; zero friction is a known value."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.identifiability import find_unphysical_values, withhold_unidentifiable
from fdhil.pipeline import analyse_window
from fdhil.records import PARAMETERS, Estimate, Result
from studies import bench
from tests.identification.bench_recordings import find_noisy_windows

VALUES = np.array([0.5, 0.005, 0.8, 0.075, 0.05, 5.0])


def _build_estimate(values: list[float], shares: list[float]) -> Estimate:
    deviations = np.array(shares) * VALUES
    return Estimate("least_squares", PARAMETERS, np.array(values), np.diag(deviations**2), {}, Result.OK)


@pytest.mark.fault("D2")
def test_uncertain_parameter_is_null_with_a_reason() -> None:
    reported = withhold_unidentifiable(_build_estimate(list(VALUES), [0.01, 0.3, 0.01, 0.01, 0.01, 0.01]), 10.0, 157.0)
    assert reported.result is Result.UNDER_EXCITED
    assert set(reported.missing) == {"L"}
    assert reported.missing["L"].code == "LowExcitation"
    assert "30 %" in reported.missing["L"].text
    assert np.isnan(reported.get_value("L"))
    assert reported.get_value("R") == 0.5


def test_zero_viscous_friction_is_published() -> None:
    reported = withhold_unidentifiable(_build_estimate([*VALUES[:4], 0.0, 5.0], [0.01] * 6), 10.0, 157.0)
    assert reported.result is Result.OK
    assert reported.get_value("ft") == 0.0


@pytest.mark.parametrize("condition", [1e7, np.inf, np.nan])
@pytest.mark.fault("D1")
def test_rank_deficiency_publishes_nothing(condition: float) -> None:
    reported = withhold_unidentifiable(_build_estimate(list(VALUES), [0.01] * 6), condition, 157.0)
    assert reported.result is Result.ILL_CONDITIONED
    assert np.isnan(reported.values).all()
    assert all(reason.code == "RankDeficient" for reason in reported.missing.values())


@pytest.mark.fault("D3")
def test_unphysical_value_is_reported() -> None:
    (reason,) = find_unphysical_values(_build_estimate([-0.5, *VALUES[1:]], [0.01] * 6))
    assert reason.code == "Unphysical"
    assert "R = -0.5" in reason.text
    assert find_unphysical_values(_build_estimate([*VALUES[:4], -0.0001, 5.0], [0.01] * 6)) == []


def test_a_drive_without_viscous_friction_is_accepted() -> None:
    outcome = analyse_window(find_noisy_windows(0.003, plant=bench.Plant(ft=1e-5))[0], Identification())
    assert outcome.verdict.accepted, outcome.verdict.reasons
