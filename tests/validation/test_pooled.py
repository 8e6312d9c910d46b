"""Pooling by information compared with a joint fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse, pool
from fdhil.records import Reason, Verdict, WindowOutcome
from studies import bench, drives, faults, real_plant
from studies.scenes import demand_of, measured, recorded
from tests.identification.bench_recordings import find_noisy_windows
from tests.identification.realistic_rapids import simulate_rapids
from tests.validation.test_interruptions import SCENE

PLANT = real_plant.Mechanics()


@pytest.mark.parametrize("seed", range(3))
def test_both_ways_of_pooling_agree_within_their_uncertainty(seed: int) -> None:
    settings = Identification()
    outcomes = [analyse(window, settings) for window in find_noisy_windows(0.005, seed=seed, moves=4)]
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
        assert pooled.get_std(name) >= 0.99 * share * pooled.get_value(name)


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


def real(mechanics: real_plant.Mechanics, moves: int = 4) -> list[WindowOutcome]:
    run, sensors = real_plant.run(mechanics, bench.shuttle(moves=moves)), real_plant.Sensors()
    recording = real_plant.recording(run, mechanics, sensors, 0.5, seed=2)
    return [analyse(window, Identification()) for window in find_windows(recording)]


@pytest.mark.parametrize("refit", [True, False])
def test_friction_that_differs_by_direction_is_a_load_and_no_jump(refit: bool) -> None:
    estimate, verdict = pool(real(replace(PLANT, asymmetry=0.1)), Identification(), refit=refit)
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert estimate.terms == ("load",)
    assert abs(estimate.get_value("load") - 0.5) < 3 * estimate.get_std("load")
    assert abs(estimate.get_value("Cd") - 5.0) < 3 * estimate.get_std("Cd")
    assert estimate.get_std("load") < 0.05


def test_a_counterweight_that_is_off_by_three_times_the_friction_is_told() -> None:
    outcomes = real(replace(PLANT, load_nm=15.0))
    assert [o.estimate is not None and o.estimate.get_value("Cd") < 0 for o in outcomes] == [False, True, False, True]
    estimate, verdict = pool(outcomes, Identification())
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert estimate.get_value("load") == pytest.approx(15.0, abs=0.02)
    assert estimate.get_value("Cd") == pytest.approx(5.0, rel=0.02)


@pytest.mark.parametrize("number", [1, 2])
def test_weight_that_moves_the_axis_is_not_told_from_one_direction(number: int) -> None:
    mechanics = real_plant.Mechanics(Cd=1.0, load_nm=5.8)
    outcomes = [analyse(window, Identification()) for window in simulate_rapids(mechanics, moves=4)]
    lowered = [outcome for outcome in outcomes if outcome.window.direction < 0][:number]
    assert all(outcome.verdict.accepted for outcome in lowered)
    _, verdict = pool(lowered, Identification())
    (reason,) = verdict.reasons
    assert reason.code == "Unphysical"
    assert "both directions" in reason.advice
    assert pool(outcomes, Identification())[1].accepted


def test_a_winding_that_warms_is_followed_to_the_newest_window() -> None:
    estimate, verdict = pool(real(replace(PLANT, warming=0.06)), Identification())
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert estimate.get_value("R") == pytest.approx(0.5 * (1 + 0.06 * 3.5 / 4), rel=0.01)


def test_a_pool_is_not_believed_from_one_direction_while_the_other_is_refused() -> None:
    outcomes = real(replace(PLANT, asymmetry=0.1))
    refusal = Reason("ValidationFailed", "friction is 2 N.m higher below 10 rad/s", "lubricate the slide-way")
    lost = Reason("StaleData", "40 samples in a row are lost", "see the bus load")
    refused, cut = (
        [
            replace(o, verdict=Verdict(False, 90.0, (reason,))) if o.window.direction < 0 else o for o in outcomes
        ]
        for reason in (refusal, lost)
    )  # fmt: skip
    estimate, verdict = pool(refused, Identification())
    assert estimate is not None
    assert [reason.code for reason in verdict.reasons] == ["OneDirection"]
    assert "negative" in verdict.reasons[0].text
    assert verdict.reasons[0].advice == refusal.advice
    _, verdict = pool(cut, Identification())  # what is lost says nothing of the drive, but it is said what is missing
    assert verdict.accepted
    assert [warning.code for warning in verdict.warnings] == ["OneDirection"]


def test_a_pool_tells_the_worst_of_its_windows_and_each_warning_once() -> None:
    outcomes = real(PLANT)
    warned = [
        replace(
            o,
            verdict=replace(o.verdict, unexplained_um=0.5 + k, warnings=(Reason("ValidationFailed", f"{k} um of it"),)),
        )
        for k, o in enumerate(outcomes)
    ]
    _, verdict = pool(warned, Identification(), refit=False)
    assert verdict.unexplained_um == 3.5
    assert [str(warning) for warning in verdict.warnings] == ["ValidationFailed: 3 um of it"]
