"""Pooling by information compared with a joint fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Reason, Verdict, WindowOutcome
from studies import bench, drives, faults, real_plant
from studies.scenes import demand_of, make_recording, measure_run
from tests.identification.bench_recordings import find_noisy_windows
from tests.identification.realistic_rapids import simulate_rapids
from tests.validation.test_interruptions import SCENE

PLANT = real_plant.Mechanics()


@pytest.mark.parametrize("seed", range(3))
def test_both_pooling_methods_agree_within_uncertainty(seed: int) -> None:
    settings = Identification()
    outcomes = [analyse_window(window, settings) for window in find_noisy_windows(0.005, seed=seed, moves=4)]
    assert len(outcomes) >= 2
    fitted, verdict = pool_windows(outcomes, settings)
    weighted, quick = pool_windows(outcomes, settings, refit=False)
    assert verdict.accepted
    assert quick.accepted
    assert fitted is not None
    assert weighted is not None
    stds = np.sqrt(np.diag(fitted.covariance))
    apart = np.abs(weighted.values - fitted.values) / stds
    assert np.max(apart) < 1.0, apart
    assert np.sqrt(np.diag(weighted.covariance)) == pytest.approx(stds, rel=0.5)


@pytest.mark.parametrize("refit", [True, False])
def test_sampling_bias_does_not_average_out(refit: bool) -> None:
    scene = replace(SCENE, dt_s=2e-3, sampling="instant")
    ways = [drives.compute_path_speeds(scene.move), -drives.compute_path_speeds(scene.move)] * 3
    rows = measure_run(
        np.random.default_rng(8), scene, drives.simulate_loop(scene.drive, demand_of(scene, *ways), scene.dt_s)
    )
    outcomes = [analyse_window(window, Identification()) for window in find_windows(make_recording(scene, rows))]
    assert sum(outcome.verdict.accepted for outcome in outcomes) >= 4
    pooled, verdict = pool_windows(outcomes, Identification(), refit=refit)
    assert verdict.accepted, verdict.reasons
    assert pooled is not None
    for name, share in (("R", 0.05), ("L", 0.2), ("K", 0.003)):
        assert pooled.get_std(name) >= 0.99 * share * pooled.get_value(name)


@pytest.mark.parametrize(("name", "share"), [("R", 0.12), ("Jt", 0.04), ("K", 0.03)])
@pytest.mark.parametrize("dt_s", [1e-3, 2e-3])
def test_shared_uncertainty_hides_no_change_between_windows(name: str, share: float, dt_s: float) -> None:
    # instants 2 ms apart leave R open by 5 %, slow means leave Jt open: either is the same in both rapids
    scene = replace(SCENE, dt_s=dt_s, sampling="instant" if name == "R" else "interval_mean")
    outcomes = []
    for seed, factor in enumerate((1.0, 1.0 + share)):
        drive = replace(scene.drive, **{name: getattr(scene.drive, name) * factor})
        rows = measure_run(np.random.default_rng(seed), scene, drives.simulate_loop(drive, demand_of(scene), dt_s))
        outcomes += [analyse_window(window, Identification()) for window in find_windows(make_recording(scene, rows))]
    assert all(outcome.verdict.accepted for outcome in outcomes)
    _, same = pool_windows([outcomes[0], outcomes[0]], Identification())
    assert same.accepted
    _, verdict = pool_windows(outcomes, Identification())
    assert [reason.text.split()[0] for reason in verdict.reasons] == [name]


def test_rapids_at_other_speed_and_acceleration_agree() -> None:
    scene = replace(SCENE, sampling="instant")
    slower = drives.Move(distance=0.3, speed=0.36, acceleration=2.0, smoothing=0.06, direction=1)
    ways = (drives.compute_path_speeds(scene.move), -drives.compute_path_speeds(slower))
    rows = measure_run(
        np.random.default_rng(4), scene, drives.simulate_loop(scene.drive, demand_of(scene, *ways), scene.dt_s)
    )
    outcomes = [analyse_window(window, Identification()) for window in find_windows(make_recording(scene, rows))]
    assert len(outcomes) == 2
    _, verdict = pool_windows(outcomes, Identification())
    assert verdict.accepted, verdict.reasons


@pytest.mark.parametrize("seed", [17, 47, 1487])
def test_gain_change_is_detected_jointly(seed: int) -> None:
    changed = faults.KINDS["gain between rapids"].make(np.random.default_rng([31, 2, seed]))
    outcomes = [analyse_window(window, Identification()) for window in find_windows(changed.recording)]
    assert all(outcome.verdict.accepted for outcome in outcomes)
    _, verdict = pool_windows(outcomes, Identification())
    assert [reason.code for reason in verdict.reasons] == ["CalibrationSuspect"]


def make_real_windows(mechanics: real_plant.Mechanics, moves: int = 4) -> list[WindowOutcome]:
    run, sensors = real_plant.simulate_axis(mechanics, bench.make_shuttle_demand(moves=moves)), real_plant.Sensors()
    recording = real_plant.make_recording(run, mechanics, sensors, 0.5, seed=2)
    return [analyse_window(window, Identification()) for window in find_windows(recording)]


@pytest.mark.parametrize("refit", [True, False])
def test_friction_difference_by_direction_is_load_not_jump(refit: bool) -> None:
    estimate, verdict = pool_windows(make_real_windows(replace(PLANT, asymmetry=0.1)), Identification(), refit=refit)
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert estimate.terms == ("load",)
    assert abs(estimate.get_value("load") - 0.5) < 3 * estimate.get_std("load")
    assert abs(estimate.get_value("Cd") - 5.0) < 3 * estimate.get_std("Cd")
    assert estimate.get_std("load") < 0.05


def test_counterweight_error_is_identified_as_load() -> None:
    outcomes = make_real_windows(replace(PLANT, load_nm=15.0))
    assert [o.estimate is not None and o.estimate.get_value("Cd") < 0 for o in outcomes] == [False, True, False, True]
    estimate, verdict = pool_windows(outcomes, Identification())
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert estimate.get_value("load") == pytest.approx(15.0, abs=0.02)
    assert estimate.get_value("Cd") == pytest.approx(5.0, rel=0.02)


@pytest.mark.parametrize("number", [1, 2])
def test_overhauling_weight_is_not_identified_from_one_direction(number: int) -> None:
    mechanics = real_plant.Mechanics(Cd=1.0, load_nm=5.8)
    outcomes = [analyse_window(window, Identification()) for window in simulate_rapids(mechanics, moves=4)]
    lowered = [outcome for outcome in outcomes if outcome.window.direction < 0][:number]
    assert all(outcome.verdict.accepted for outcome in lowered)
    _, verdict = pool_windows(lowered, Identification())
    (reason,) = verdict.reasons
    assert reason.code == "Unphysical"
    assert "both directions" in reason.advice
    assert pool_windows(outcomes, Identification())[1].accepted


def test_warming_winding_is_tracked_to_newest_window() -> None:
    estimate, verdict = pool_windows(make_real_windows(replace(PLANT, warming=0.06)), Identification())
    assert verdict.accepted, verdict.reasons
    assert estimate is not None
    assert estimate.get_value("R") == pytest.approx(0.5 * (1 + 0.06 * 3.5 / 4), rel=0.01)


def test_pool_is_refused_if_one_direction_is_refused() -> None:
    outcomes = make_real_windows(replace(PLANT, asymmetry=0.1))
    refusal = Reason("ValidationFailed", "friction is 2 N.m higher below 10 rad/s", "lubricate the slide-way")
    lost = Reason("StaleData", "40 samples in a row are lost", "see the bus load")
    refused, cut = (
        [
            replace(o, verdict=Verdict(False, 90.0, (reason,))) if o.window.direction < 0 else o for o in outcomes
        ]
        for reason in (refusal, lost)
    )  # fmt: skip
    estimate, verdict = pool_windows(refused, Identification())
    assert estimate is not None
    assert [reason.code for reason in verdict.reasons] == ["OneDirection"]
    assert "negative" in verdict.reasons[0].text
    assert verdict.reasons[0].advice == refusal.advice
    _, verdict = pool_windows(
        cut, Identification()
    )  # what is lost says nothing of the drive, but it is said what is missing
    assert verdict.accepted
    assert [warning.code for warning in verdict.warnings] == ["OneDirection"]


def test_pool_reports_worst_window_and_each_warning_once() -> None:
    outcomes = make_real_windows(PLANT)
    warned = [
        replace(
            o,
            verdict=replace(o.verdict, unexplained_um=0.5 + k, warnings=(Reason("ValidationFailed", f"{k} um of it"),)),
        )
        for k, o in enumerate(outcomes)
    ]
    _, verdict = pool_windows(warned, Identification(), refit=False)
    assert verdict.unexplained_um == 3.5
    assert [str(warning) for warning in verdict.warnings] == ["ValidationFailed: 3 um of it"]
