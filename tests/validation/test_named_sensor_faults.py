"""Faults with a code and a figure: backlash, drifting sensors, a gain that changed between two rapids."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.estimators.maximum_likelihood import fit_windows
from fdhil.identification.rapid_windows import find_windows
from fdhil.pipeline import analyse_window, pool_windows
from fdhil.records import Window, freeze_array
from fdhil.validation.backlash import detect_backlash, measure_dead_band, measure_overrun
from fdhil.validation.model_deficiencies import select_deficiencies
from fdhil.validation.structure_tests import run_structure_tests
from studies import drives, faults
from studies.drives import Drive, Move
from studies.scenes import Scene, demand_of, make_recording, measure_run
from tests.identification.bench_recordings import find_noisy_windows
from tests.validation.test_interruptions import DRIVE, SCENE

SETTINGS = Identification()


def _add_backlash(um: float) -> Window:
    drive = replace(DRIVE, backlash_rad=um * 1e-6 / DRIVE.pitch_m * 2 * np.pi)
    demand = demand_of(SCENE, -drives.compute_path_speeds(SCENE.move))  # against the flank that it rests on
    rows = measure_run(np.random.default_rng(3), SCENE, drives.simulate_loop(drive, demand, SCENE.dt_s))
    return find_windows(make_recording(SCENE, rows))[0]


@pytest.mark.parametrize("um", [0.0, 80.0, 200.0])
def test_backlash_is_measured_in_um_with_interval(um: float) -> None:
    found = measure_dead_band(_add_backlash(um))
    assert found is not None
    assert 0 < found.std_um < 13
    assert abs(found.um - um) < 3 * found.std_um
    texts = [reason.text for reason in analyse_window(_add_backlash(um), SETTINGS).verdict.reasons]
    assert any("backlash" in text for text in texts) == (um > 0)


@pytest.mark.parametrize("name", ["voltage", "current", "speed"])
@pytest.mark.parametrize("fault", ["gain", "zero"])
def test_sensor_drift_is_named_with_amount(name: str, fault: str) -> None:
    window = find_noisy_windows(0.002)[0]
    field = {"voltage": "voltage_v", "current": "current_a", "speed": "speed_rad_s"}[name]
    values = np.array(getattr(window, field))
    course = np.linspace(0.0, 1.0, values.size)
    wrong = values * (1 + 0.08 * course) if fault == "gain" else values + 0.05 * np.abs(values).max() * course
    changed: Window = replace(window, **{field: freeze_array(wrong)})  # type: ignore[arg-type]  # an array of the record
    reasons = [r for r in analyse_window(changed, SETTINGS).verdict.reasons if r.code == "CalibrationSuspect"]
    assert reasons
    assert all(re.search(r"[-+]?\d", reason.text) for reason in reasons)


def test_scaled_noise_is_no_evidence_of_gain_change() -> None:
    # a drive that creeps to rest at little current: every reading holds its own innovation, at some 7 deviations in all
    drive = Drive(
        R=0.47, L=0.0051, K=0.468, Jt=0.00558, ft=0.0067, Cd=1.36, pitch_m=0.005, position_gain=22.7, feedforward=0.47,
        speed_hz=32.0, current_hz=264.0, current_limit=150.0, voltage_limit=380.0,
    )  # fmt: skip
    move = Move(distance=0.071, speed=0.245, acceleration=6.2, smoothing=0.005, direction=-1)
    scene = Scene(drive, move, 2.5e-4, "interval_mean", 0.003, (1e-4, 1e-4, 1e-4), 1e-7, 0.16)
    run = drives.simulate_loop(drive, demand_of(scene), scene.dt_s)
    shares = []
    for seed in range(5):
        fit = fit_windows(
            find_windows(make_recording(scene, measure_run(np.random.default_rng(seed), scene, run))), SETTINGS
        )
        assert fit is not None
        (gain,) = (f for f in run_structure_tests(fit) if "gain of current" in f.text)
        shares.append(gain.statistic)
    assert np.abs(shares).max() < 4.0


def test_creep_to_rest_is_no_evidence_of_gain_change() -> None:
    good = faults.make_good_recording(np.random.default_rng([81, 1, 870]))  # 7 deviations were seen after the move
    assert [analyse_window(window, SETTINGS).verdict.reasons for window in find_windows(good.recording)] == [(), ()]


@pytest.mark.parametrize(
    ("study", "seed", "text"),
    [
        (1, 1813, "the gain of current drifts by +6"),
        (1, 1933, "the gain of current drifts by +5"),
        # instants, of whose course a torque within the move explains nearly as much
        (2, 1963, "the gain of current drifts by -5"),
    ],
)
def test_small_gain_drift_is_refused_with_its_size(study: int, seed: int, text: str) -> None:
    drifting = faults.KINDS["gain drift"].make(np.random.default_rng([study, 2, seed]))
    (window,) = find_windows(drifting.recording)
    fit = fit_windows([window], SETTINGS)
    assert fit is not None
    first, *_ = select_deficiencies(fit, run_structure_tests(fit))
    assert first.finding.text.format(first.finding.amplitude).startswith(text)
    assert abs(first.finding.amplitude) == pytest.approx(drifting.severity, rel=0.15)
    assert "CalibrationSuspect" in {reason.code for reason in analyse_window(window, SETTINGS).verdict.reasons}


@pytest.mark.parametrize(("field", "name"), [("voltage_v", "voltage"), ("current_a", "current")])
def test_gain_change_between_rapids_is_named_once(field: str, name: str) -> None:
    there, back = find_noisy_windows(0.002, moves=2)
    louder: Window = replace(back, **{field: freeze_array(1.06 * np.array(getattr(back, field)))})  # type: ignore[arg-type]
    _, verdict = pool_windows([analyse_window(there, SETTINGS), analyse_window(louder, SETTINGS)], SETTINGS)
    (reason,) = verdict.reasons
    assert reason.code == "CalibrationSuspect"
    assert f"the gain of {name} changes by +" in reason.text
    share = float(re.findall(r"([-+][\d.]+)%", reason.text)[0])
    assert share == pytest.approx(6.0, abs=0.5)


def test_small_dead_band_is_confirmed_by_table_overrun() -> None:
    noisy = replace(SCENE, noise=0.005, dt_s=2e-3, drive=replace(DRIVE, pitch_m=0.04), position_step_m=5e-6)
    accepted = 0
    for seed in range(6):
        for um in (0.0, 100.0):
            drive = replace(noisy.drive, backlash_rad=um * 1e-6 / noisy.drive.pitch_m * 2 * np.pi)
            demand = demand_of(noisy, -drives.compute_path_speeds(noisy.move))
            rows = measure_run(np.random.default_rng(seed), noisy, drives.simulate_loop(drive, demand, noisy.dt_s))
            (window,) = find_windows(make_recording(noisy, rows))
            second = measure_overrun(window)
            assert second is not None
            assert abs(second.um - um) < 4 * second.std_um
            found = detect_backlash(window)
            assert (found is None) or um > 0.0
            accepted += found is not None
    assert accepted >= 5
