"""The studies' own arithmetic: what they conclude from runs follows from the runs."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.config import Identification
from studies import comparison, drift, estimators
from studies.comparison_page import paragraph


def test_the_hausman_test_tells_a_bias_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    errors = rng.standard_normal((400, 2, 3, 6))
    errors[:, 0, 1, 3] += 8.0
    shares = comparison.rejections(errors)
    assert shares[0, 1, 3] == 1.0
    unbiased = np.delete(shares[:, :-1].ravel(), 6 + 3)
    assert unbiased.mean() == pytest.approx(0.05, abs=0.01)
    assert (shares[:, -1] == 0).all()


def test_every_method_finds_a_quiet_rapid() -> None:
    windows = estimators.noisy(comparison.clean(1e-3), 1e-5, 0)
    found = comparison.values_of(windows, Identification().lowpass_hz)
    assert len(found) == len(comparison.METHODS) - 1
    for name, values in zip(comparison.METHODS, found, strict=False):
        assert values == pytest.approx(estimators.TRUTH, rel=0.08), name


@pytest.mark.parametrize("period_s", comparison.PERIODS_S)
def test_the_bound_grows_with_the_period_and_the_noise(period_s: float) -> None:
    quiet, loud = (estimators.bound(comparison.clean(period_s), noise) for noise in (0.001, 0.005))
    assert loud == pytest.approx(5 * quiet, rel=0.05)


def test_a_step_of_the_load_is_told_at_once_in_the_study() -> None:
    codes, published, alone = drift.stepped(0)
    assert codes == ("LoadChanged",)
    assert published == 2
    assert alone


def test_paragraphs_fit_the_page() -> None:
    lines = paragraph("a low-pass " * 60)
    assert max(map(len, lines)) <= 120
    assert lines[-1] == ""
