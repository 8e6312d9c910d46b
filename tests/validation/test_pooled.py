"""Pooling by information against fitting everything once more."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.validation import analyse, pool
from tests.identification.recorded import windows


@pytest.mark.parametrize("seed", range(3))
def test_both_ways_of_pooling_agree_within_their_uncertainty(seed: int) -> None:
    settings = Identification()
    outcomes = [analyse(window, settings) for window in windows(0.005, seed=seed, moves=4)]
    assert len(outcomes) >= 2
    fitted, verdict = pool(outcomes, settings)
    weighted, quick = pool(outcomes, settings, refit=False)
    assert verdict.accepted
    assert quick.accepted
    assert fitted is not None
    assert weighted is not None
    stds = np.sqrt(np.diag(fitted.covariance))
    apart = np.abs(weighted.values - fitted.values) / stds
    assert np.max(apart) < 1.0, apart
    assert np.sqrt(np.diag(weighted.covariance)) == pytest.approx(stds, rel=0.5)
