"""Jt, ft and Cd from current and position alone, on an independent plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.identification.torque_fit import build_torque_estimate, estimate_current_lag_s, fit_torque
from fdhil.identification.torque_samples import extract_torque_samples
from fdhil.records import RATIOS, Estimate, Result, Window, freeze_array
from studies.real_plant import SLOW, SLOW_LOOPS, Mechanics, Run, Sensors, make_recording, simulate_axis
from tests.identification.no_voltage_recordings import SCREW, build_shuttle_demand, find_screw_windows

SETTINGS = Identification()
TOLD = ("Jt", "ft", "Cd")


def estimate_windows(window: Window, **known: float) -> Estimate:
    return build_torque_estimate(window, fit_torque(window, SETTINGS), known)


@pytest.mark.parametrize("way", [0, 1])
def test_single_rapid_identifies_inertia_and_friction_of_its_direction(way: int) -> None:
    window = find_screw_windows()[way]
    found, truth = estimate_windows(window), SCREW.truth()
    truth["Cd"] += window.direction * SCREW.load_nm
    assert found.get_value("Jt") == pytest.approx(truth["Jt"], rel=0.005)
    for name in ("ft", "Cd"):
        assert found.get_value(name) == pytest.approx(truth[name], rel=0.03)
    assert (found.get_value("K"), found.get_std("K"), found.given) == (SCREW.K, 0.0, ("K",))
    assert set(found.missing) == {"R", "L"}
    assert found.result is Result.UNDER_EXCITED


@pytest.mark.parametrize("speed", ["sensor", "difference", "middle"])
def test_speed_source_does_not_change_the_estimate(speed: str) -> None:
    found = estimate_windows(find_screw_windows(speed=speed, noise=3e-4)[0])
    assert found.get_value("Jt") == pytest.approx(SCREW.Jt, rel=0.01)
    assert found.get_value("Cd") == pytest.approx(SCREW.Cd + SCREW.load_nm, rel=0.06)


def test_torque_constant_of_the_recording_overrides_the_data_sheet() -> None:
    window = find_screw_windows()[0]
    found = estimate_windows(window, R=0.6, L=0.003, K=0.5)
    assert found.given == ("R", "L", "K")
    assert (found.get_value("R"), found.get_value("L"), found.get_value("K")) == (0.6, 0.003, SCREW.K)
    assert not found.missing
    assert found.result is Result.OK
    other = estimate_windows(replace(window, torque_constant_nm_per_a=None), R=0.6, L=0.003, K=2 * SCREW.K)
    assert other.get_value("Jt") == pytest.approx(2 * found.get_value("Jt"))
    assert other.get_std("Cd") == pytest.approx(2 * found.get_std("Cd"))


def test_missing_torque_constant_yields_ratios() -> None:
    window = find_screw_windows()[0]
    found = estimate_windows(replace(window, torque_constant_nm_per_a=None))
    assert set(found.missing) == {"R", "L", "K", *TOLD}
    assert not found.terms
    with_it = estimate_windows(window)
    for ratio, name in zip(RATIOS, TOLD, strict=True):
        assert found.get_value(ratio) * SCREW.K == pytest.approx(with_it.get_value(name))


def test_intervals_cover_the_truth_without_voltage() -> None:
    """Over 24 windows of two plants the error in deviations has an RMS near 1."""
    slow = simulate_axis(SLOW, build_shuttle_demand(4, 0.2, 0.2, 2.0), SLOW_LOOPS)
    errors = []
    for mechanics, made in ((SLOW, slow), (replace(SCREW, static=0.0, screw_ripple=0.0), None)):
        for seed in range(3):
            windows = (
                find_screw_windows(4, seed, mechanics) if made is None else _simulate_windows(made, mechanics, seed)
            )
            for window in windows:
                found, truth = estimate_windows(window), mechanics.truth()
                truth["Cd"] += window.direction * mechanics.load_nm
                errors.append([(found.get_value(name) - truth[name]) / found.get_std(name) for name in TOLD])
    assert len(errors) == 24
    assert (np.sqrt(np.mean(np.square(errors), axis=0)) < 1.4).all()
    assert (np.sqrt(np.mean(np.square(errors), axis=0)) > 0.4).all()


def _simulate_windows(made: Run, mechanics: Mechanics, seed: int, rapid_m_s: float = 0.2) -> list[Window]:
    read = make_recording(made, mechanics, Sensors(), rapid_m_s, seed, voltage=False)
    return find_windows(replace(read, torque_constant_nm_per_a=mechanics.K))


@pytest.mark.parametrize("dt_s", [0.004, 0.010])
def test_long_samples_yield_the_same_parameters(dt_s: float) -> None:
    """Four axes on one bus allow a sample every 4 ms, many machines one in 10; the NC smooths its ramps."""
    smooth = np.convolve(np.pad(build_shuttle_demand(2, 0.4, 0.5, 4.0), 50, "edge"), np.full(90, 1 / 90), "same")[
        50:-50
    ]
    for window in _simulate_windows(simulate_axis(Mechanics(), smooth, dt_s=dt_s), Mechanics(), 1, 0.5):
        found = estimate_windows(window)
        for name, truth in Mechanics().truth().items():
            if name in TOLD:
                assert abs(found.get_value(name) - truth) < 3 * found.get_std(name) < 0.1 * truth


def test_stribeck_friction_is_added_where_worthwhile() -> None:
    risen = replace(SCREW, static=-0.5, static_speed_rad_s=30.0, screw_ripple=0.0)
    found = estimate_windows(find_screw_windows(2, 0, risen)[0])
    assert "stribeck" in found.terms
    assert found.get_value("stribeck") == pytest.approx(-0.5 * SCREW.Cd, rel=0.3)
    assert found.get_value("stribeck_speed") == pytest.approx(30.0, rel=0.4)
    assert found.get_value("Cd") == pytest.approx(SCREW.Cd + SCREW.load_nm, rel=0.1)
    assert found.get_std("stribeck_speed") > 0


def test_screw_ripple_is_added_with_its_phase() -> None:
    rippled = replace(SCREW, static=0.0, screw_ripple=0.3, screw_phase=1.0, pitch_m=0.01)
    found = estimate_windows(find_screw_windows(2, 0, rippled)[0])
    # at rapid speed the screw turns 15 times a second, well below the low-pass
    assert found.get_value("ripple_screw_1") == pytest.approx(0.3 * SCREW.Cd, rel=0.05)
    assert found.get_value("ripple_screw_1_phase") == pytest.approx(1.0, abs=0.05)


def test_late_current_is_reported_without_bias() -> None:
    window = find_screw_windows()[0]
    late = replace(window, current_a=freeze_array(np.concatenate([np.zeros(3), window.current_a[:-3]])))
    fitted = fit_torque(late, SETTINGS)
    assert fitted is not None
    late_by, std = estimate_current_lag_s(fitted)
    assert late_by == pytest.approx(3e-3, abs=max(4 * std, 2e-4))
    assert build_torque_estimate(late, fitted, {}).get_value("Jt") == pytest.approx(SCREW.Jt, rel=0.01)


def test_too_few_samples_yield_an_empty_estimate() -> None:
    window = find_screw_windows()[0]
    lost = replace(window, current_a=freeze_array(np.full(window.n, np.nan)))
    assert extract_torque_samples(lost, SETTINGS) is None
    assert fit_torque(lost, SETTINGS) is None
    assert estimate_windows(lost).result is Result.UNDER_EXCITED


def test_compliant_screw_does_not_bias_the_inertia() -> None:
    found = estimate_windows(find_screw_windows(2, 0, replace(SCREW, resonance_hz=60.0))[0])
    assert found.get_value("Jt") == pytest.approx(SCREW.Jt, rel=0.005)
