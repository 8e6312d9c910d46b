"""The derivative operators: their moments, and the paper's rounded coefficients."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.identification.derivatives import ZERO_FORCING_1, Operator, derivative
from studies.derivative_operators import OPERATORS


def test_zero_forcing_is_the_papers() -> None:
    printed = (0.2953, -1.386, 0.886, 0.2047)
    np.testing.assert_allclose(ZERO_FORCING_1.weights, printed, atol=5e-5)
    b, j = np.array(ZERO_FORCING_1.weights), np.array(ZERO_FORCING_1.offsets)
    kink = (b[:, None] * b[None, :] * np.abs(j[:, None] - j[None, :]) ** 3).sum()
    assert abs(kink) < 1e-13
    assert (b * b).sum() == pytest.approx(2.835, abs=1e-3)


@pytest.mark.parametrize("operator", OPERATORS.values(), ids=str)
def test_constants_vanish_and_lines_keep_their_slope(operator: Operator) -> None:
    t = np.linspace(0.0, 0.39, 40)
    slope = derivative(3.0 + 2.0 * t, 0.01, operator)
    inside = slope[operator.before : 40 - operator.after]
    np.testing.assert_allclose(inside, 2.0, rtol=1e-9)
    assert np.isnan(slope[: operator.before]).all()
    assert np.isfinite(inside).all()


@pytest.mark.parametrize("name", ["zero_forcing_1", "central", "savitzky_golay_7"])
def test_second_order_operators_are_exact_on_parabolas(name: str) -> None:
    t = np.linspace(0.0, 0.39, 40)
    slope = derivative(t * t, 0.01, OPERATORS[name])
    known = np.isfinite(slope)
    np.testing.assert_allclose(slope[known], 2 * t[known], atol=1e-12)


def test_a_lost_sample_takes_exactly_its_stencil() -> None:
    values = np.linspace(0.0, 19.0, 20)
    values[10] = np.nan
    lost = np.flatnonzero(~np.isfinite(derivative(values, 1.0)))
    assert set(lost) == {0, 1, 19, 9, 10, 11, 12}


def test_too_short_is_all_unknown() -> None:
    assert np.isnan(derivative(np.ones(3), 1.0)).all()
