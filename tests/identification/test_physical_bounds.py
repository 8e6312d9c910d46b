"""An estimate that violates a physical bound by chance is projected onto it; any other is unchanged to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdhil.identification.identifiability import find_unphysical_values
from fdhil.identification.physical_bounds import bound_estimate
from fdhil.model.model_terms import compute_friction_torque
from fdhil.model.physical_limits import list_bounds
from fdhil.records import PARAMETERS, Estimate, Float, Result

TERMS = ("load", "viscous_positive", "viscous_negative", "stribeck", "stribeck_speed")
NAMES = (*PARAMETERS, *TERMS)
TRUE = np.array([0.5, 0.005, 0.8, 0.075, 0.05, 5.0, 1.0, 0.06, 0.04, -2.0, 10.0])


def build_estimate(values: Float, covariance: Float | None = None, names: tuple[str, ...] = NAMES) -> Estimate:
    """Return an estimate, by default with uncertain friction."""
    deviations = 0.01 * np.abs(values)
    deviations[[names.index(name) for name in names if name in ("Cd", "stribeck", "ft")]] = 2.0
    made = np.diag(deviations**2) if covariance is None else covariance
    return Estimate("maximum_likelihood", names, values, made, {}, Result.OK)


def replace_values(**values: float) -> Float:
    """Return the true values with some replaced."""
    reported = TRUE.copy()
    for name, value in values.items():
        reported[NAMES.index(name)] = value
    return reported


def test_physical_estimate_is_unchanged() -> None:
    reported = build_estimate(TRUE)
    assert bound_estimate(reported) is reported
    assert bound_estimate(reported, -1) is reported


def test_insignificantly_negative_breakaway_friction_becomes_zero() -> None:
    reported = build_estimate(replace_values(Cd=4.95, stribeck=-6.4))
    assert find_unphysical_values(reported) == []
    within = bound_estimate(reported)
    assert within.get_value("Cd") + within.get_value("stribeck") == 0.0
    # both move, the more the less certain they are
    assert within.get_value("Cd") == pytest.approx(5.675)
    assert within.covariance is reported.covariance


def test_significantly_negative_breakaway_friction_is_refused() -> None:
    reported = build_estimate(replace_values(Cd=4.95, stribeck=-16.4))
    (reason,) = find_unphysical_values(reported)
    assert (reason.code, "Cd + stribeck = -11.45" in reason.text) == ("Unphysical", True)


def test_correlated_values_follow_the_bounded_one() -> None:
    names = PARAMETERS
    covariance = np.zeros((6, 6))
    covariance[4:, 4:] = [[1e-4, -9e-3], [-9e-3, 1.0]]  # ft and Cd nearly compensate each other
    within = bound_estimate(build_estimate(np.array([*TRUE[:4], -0.001, 6.0]), covariance, names))
    assert within.get_value("ft") == 0.0
    assert within.get_value("Cd") == pytest.approx(6.0 - 0.09)


def test_one_way_moves_report_a_load_beyond_dry_friction() -> None:
    names, covariance = PARAMETERS, np.diag([1e-6] * 6)
    lowered = build_estimate(np.array([*TRUE[:5], -10.0]), covariance, names)
    assert find_unphysical_values(lowered, one_way=True) == []
    for direction in (1, -1):
        within = bound_estimate(lowered, direction)
        assert (within.get_value("Cd"), within.get_value("load")) == (0.0, -10.0 * direction)
        assert within.get_std("load") == pytest.approx(1e-3)
        speed = np.array([50.0 * direction])
        assert compute_friction_torque(within.build_parameters(), speed, np.zeros(1)) == pytest.approx(
            direction * (0.05 * 50.0 - 10.0)
        )  # the constraint is the same


@given(st.integers(0, 2**32 - 1))
def test_any_estimate_is_projected_within_all_bounds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 1.0, (len(NAMES), len(NAMES))) * np.abs(TRUE)
    values = TRUE + rng.choice([0.1, 1.0, 3.0]) * root @ rng.normal(0.0, 1.0, len(NAMES))
    within = bound_estimate(build_estimate(values, root @ root.T))
    reported = dict(zip(NAMES, within.values.tolist(), strict=True))
    assert all(bound.compute_violation(reported) <= 0.0 for bound in list_bounds(NAMES))
