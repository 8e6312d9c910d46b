"""Pooling by information against fitting everything once more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.windows import find_windows
from fdhil.pipeline import analyse, pool
from studies import drives, faults
from studies.scenes import demand_of, measured, recorded
from tests.identification.recorded import windows
from tests.validation.test_interruptions import SCENE


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


@pytest.mark.parametrize("refit", [True, False])
def test_what_instants_miss_is_the_same_in_every_rapid_and_does_not_average_away(refit: bool) -> None:
    scene = replace(SCENE, dt_s=2e-3, sampling="instant")
    ways = [drives.rates(scene.move), -drives.rates(scene.move)] * 3
    rows = measured(np.random.default_rng(8), scene, drives.run(scene.drive, demand_of(scene, *ways), scene.dt_s))
    outcomes = [analyse(window, Identification()) for window in find_windows(recorded(scene, rows))]
    assert sum(outcome.verdict.accepted for outcome in outcomes) >= 4
    pooled, verdict = pool(outcomes, Identification(), refit=refit)
    assert verdict.accepted, verdict.reasons
    assert pooled is not None
    for name, share in (("R", 0.05), ("L", 0.2), ("K", 0.003)):
        assert pooled.std(name) >= 0.99 * share * pooled.value(name)


@pytest.mark.parametrize(("name", "share"), [("R", 0.12), ("Jt", 0.04), ("K", 0.03)])
@pytest.mark.parametrize("dt_s", [1e-3, 2e-3])
def test_a_doubt_that_windows_share_hides_no_change_between_them(name: str, share: float, dt_s: float) -> None:
    # instants 2 ms apart leave R open by 5 %, slow means leave Jt open: either is the same in both rapids
    scene = replace(SCENE, dt_s=dt_s, sampling="instant" if name == "R" else "interval_mean")
    outcomes = []
    for seed, factor in enumerate((1.0, 1.0 + share)):
        drive = replace(scene.drive, **{name: getattr(scene.drive, name) * factor})
        rows = measured(np.random.default_rng(seed), scene, drives.run(drive, demand_of(scene), dt_s))
        outcomes += [analyse(window, Identification()) for window in find_windows(recorded(scene, rows))]
    assert all(outcome.verdict.accepted for outcome in outcomes)
    _, same = pool([outcomes[0], outcomes[0]], Identification())
    assert same.accepted
    _, verdict = pool(outcomes, Identification())
    assert [reason.text.split()[0] for reason in verdict.reasons] == [name]


def test_rapids_of_other_speed_and_acceleration_agree() -> None:
    scene = replace(SCENE, sampling="instant")
    slower = drives.Move(distance=0.3, speed=0.36, acceleration=2.0, smoothing=0.06, direction=1)
    ways = (drives.rates(scene.move), -drives.rates(slower))
    rows = measured(np.random.default_rng(4), scene, drives.run(scene.drive, demand_of(scene, *ways), scene.dt_s))
    outcomes = [analyse(window, Identification()) for window in find_windows(recorded(scene, rows))]
    assert len(outcomes) == 2
    _, verdict = pool(outcomes, Identification())
    assert verdict.accepted, verdict.reasons


@pytest.mark.parametrize("seed", [17, 47, 1487])
def test_a_gain_that_changes_between_rapids_is_told_where_no_parameter_alone_tells_it(seed: int) -> None:
    changed = faults.KINDS["gain between rapids"].make(np.random.default_rng([31, 2, seed]))
    outcomes = [analyse(window, Identification()) for window in find_windows(changed.recording)]
    assert all(outcome.verdict.accepted for outcome in outcomes)
    _, verdict = pool(outcomes, Identification())
    assert [reason.code for reason in verdict.reasons] == ["CalibrationSuspect"]
