"""The derivative operators: their moments, and the paper's rounded coefficients."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.identification.derivatives import ZERO_FORCING_1, DerivativeStencil, differentiate_signal
from studies.derivative_operators import OPERATORS


def test_zero_forcing_weights_match_the_paper() -> None:
    printed = (0.2953, -1.386, 0.886, 0.2047)
    np.testing.assert_allclose(ZERO_FORCING_1.weights, printed, atol=5e-5)
    b, j = np.array(ZERO_FORCING_1.weights), np.array(ZERO_FORCING_1.offsets)
    kink = (b[:, None] * b[None, :] * np.abs(j[:, None] - j[None, :]) ** 3).sum()
    assert abs(kink) < 1e-13
    assert (b * b).sum() == pytest.approx(2.835, abs=1e-3)


@pytest.mark.parametrize("operator", OPERATORS.values(), ids=str)
def test_derivative_of_constants_and_lines_is_exact(operator: DerivativeStencil) -> None:
    t = np.linspace(0.0, 0.39, 40)
    slope = differentiate_signal(3.0 + 2.0 * t, 0.01, operator)
    inside = slope[operator.before : 40 - operator.after]
    np.testing.assert_allclose(inside, 2.0, rtol=1e-9)
    assert np.isnan(slope[: operator.before]).all()
    assert np.isfinite(inside).all()


@pytest.mark.parametrize("name", ["zero_forcing_1", "central", "savitzky_golay_7"])
def test_second_order_stencils_are_exact_on_parabolas(name: str) -> None:
    t = np.linspace(0.0, 0.39, 40)
    slope = differentiate_signal(t * t, 0.01, OPERATORS[name])
    known = np.isfinite(slope)
    np.testing.assert_allclose(slope[known], 2 * t[known], atol=1e-12)


def test_lost_sample_invalidates_exactly_its_stencil() -> None:
    values = np.linspace(0.0, 19.0, 20)
    values[10] = np.nan
    lost = np.flatnonzero(~np.isfinite(differentiate_signal(values, 1.0)))
    assert set(lost) == {0, 1, 19, 9, 10, 11, 12}


def test_too_short_signal_has_nan_derivative() -> None:
    assert np.isnan(differentiate_signal(np.ones(3), 1.0)).all()
