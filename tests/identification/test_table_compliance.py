"""A compliant screw seen from the table: an independent plant of known resonance, encoder and accelerometer."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.rapid_windows import find_windows
from fdhil.identification.speed_alignment import align_speed_to_samples
from fdhil.identification.table_compliance import (
    TERMS,
    Compliance,
    check_configured_resonance,
    estimate_compliance,
    merge_compliance,
)
from fdhil.pipeline import analyse_window
from fdhil.records import Float, Parameters, Window, freeze_array
from studies import real_plant
from studies.bench import make_shuttle_demand
from studies.real_plant import Mechanics, Sensors
from tests.bench import bench_config
from tests.tiers import sampled

DT_S = 1e-3
TRUE = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
KINDS = ("constant", "nan", "huge", "infinite", "motor", "steps")
DAMPING, SHARE = 0.02, 0.6  # of the plant


def compute_table_accelerations(mechanics: Mechanics, demand_m: Float, rows: int) -> Float:
    """Return the table's acceleration, averaged about each sample, from a run whose samples are steps of the
    simulation.
    """
    fine = real_plant.simulate_axis(mechanics, demand_m, None, real_plant.STEP_S).table_m
    every = round(DT_S / real_plant.STEP_S)
    steps = np.gradient(np.gradient(fine, real_plant.STEP_S), real_plant.STEP_S)
    return np.convolve(steps, np.ones(every) / every, "same")[::every][:rows]


@cache
def simulate_table_rapid(hertz: float, seed: int = 1) -> Window:
    """Return a rapid of an axis with this resonance (0: rigid), with both table sensors and noise."""
    mechanics, demand_m = Mechanics(resonance_hz=hertz), make_shuttle_demand()
    run = real_plant.simulate_axis(mechanics, demand_m, None, DT_S)
    sensors = Sensors(noise=0.001, speed="difference")
    rng = np.random.default_rng(seed)
    table_mm = np.round(1e3 * run.table_m + 5e-5 * rng.standard_normal(run.table_m.size), 4)
    pushed = (
        compute_table_accelerations(mechanics, demand_m, table_mm.size)
        + 0.3
        + 0.05 * rng.standard_normal(table_mm.size)
    )
    recording = replace(
        real_plant.make_recording(run, mechanics, sensors, 0.5, seed),
        table_mm=freeze_array(table_mm),
        table_m_s2=freeze_array(pushed),
    )
    (window,) = find_windows(recording)
    return window


def identify_compliance(window: Window, **changes: Float | None) -> Compliance | None:
    return estimate_compliance(align_speed_to_samples(replace(window, **changes)), TRUE)  # type: ignore[arg-type]


def assert_within(found: Compliance | None, hertz: float, deviations: float = 3.0) -> None:
    assert found is not None
    std = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.values - np.array([hertz, DAMPING, SHARE])) < deviations * std), (found.values, std)


@pytest.mark.parametrize("hertz", sampled([80.0, 50.0, 120.0], every=3))
def test_table_encoder_identifies_resonance_damping_and_share(hertz: float) -> None:
    found = identify_compliance(simulate_table_rapid(hertz), table_m_s2=None)
    assert_within(found, hertz)
    assert found is not None
    held_hz = found.values[0] * math.sqrt(1 - found.values[2])  # the deflection of the screw: determined much better
    assert held_hz == pytest.approx(hertz * math.sqrt(1 - SHARE), rel=2e-3)
    assert math.sqrt(found.covariance[0, 0]) < 0.1 * hertz


@pytest.mark.parametrize("hertz", [50.0, 80.0])
def test_accelerometer_identifies_resonance_and_damping(hertz: float) -> None:
    found = identify_compliance(simulate_table_rapid(hertz), table_mm=None)
    assert_within(found, hertz)
    assert found is not None
    assert found.values[0] == pytest.approx(hertz, rel=0.05)


def test_accelerometer_gain_and_lag_do_not_change_the_resonance() -> None:
    window = simulate_table_rapid(50.0)
    assert window.table_m_s2 is not None
    found = identify_compliance(window, table_mm=None, table_m_s2=freeze_array(1.05 * np.roll(window.table_m_s2, 2)))
    assert_within(found, 50.0)
    assert found is not None
    assert found.late_s == pytest.approx(2e-3, abs=5e-4)


def test_rigid_screw_yields_no_compliance() -> None:
    assert identify_compliance(simulate_table_rapid(0.0), table_m_s2=None) is None
    assert identify_compliance(simulate_table_rapid(0.0), table_mm=None) is None


def test_missing_or_mostly_lost_sensor_yields_no_compliance() -> None:
    window = simulate_table_rapid(80.0)
    assert window.table_mm is not None
    lost = window.table_mm.copy()
    lost[::3] = np.nan
    assert identify_compliance(window, table_mm=None, table_m_s2=None) is None
    assert identify_compliance(window, table_mm=freeze_array(lost), table_m_s2=None) is None


def test_sensor_unrelated_to_the_table_yields_no_compliance() -> None:
    noise = np.random.default_rng(3).standard_normal(simulate_table_rapid(80.0).n)
    assert identify_compliance(simulate_table_rapid(80.0), table_mm=freeze_array(noise), table_m_s2=None) is None
    assert identify_compliance(simulate_table_rapid(80.0), table_mm=None, table_m_s2=freeze_array(noise)) is None


def test_merged_compliance_keeps_the_shared_doubt() -> None:
    outcome = analyse_window(replace(simulate_table_rapid(80.0), table_m_s2=None), Identification())
    estimate = outcome.estimate
    assert estimate is not None
    assert set(TERMS) <= set(estimate.terms)
    assert estimate.get_value("resonance") == pytest.approx(80.0, rel=0.1)
    assert estimate.systematic is not None
    assert estimate.systematic.shape[0] == len(estimate.names) == estimate.covariance.shape[0]
    found = identify_compliance(simulate_table_rapid(50.0), table_m_s2=None)
    assert found is not None
    again = merge_compliance(estimate, found)  # it replaces the first one
    assert again.names == estimate.names
    assert again.get_value("resonance") == pytest.approx(50.0, rel=0.1)


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize(("configured", "codes"), [(None, []), (80.0, []), (60.0, ["ResonanceDiffers"])])
def test_different_configured_resonance_is_warned_of(configured: float | None, codes: list[str]) -> None:
    found = identify_compliance(simulate_table_rapid(80.0), table_m_s2=None)
    assert found is not None
    axis = bench_config("X").axis["X"].model_copy(update={"resonance_hz": configured})
    reported = check_configured_resonance(found, axis)
    assert [reason.code for reason in reported] == codes
    assert all("60 Hz" in reason.text for reason in reported)
    assert check_configured_resonance(found, None) == []


@pytest.mark.usefixtures("real_time")
def test_true_table_error_is_reported() -> None:
    window = replace(simulate_table_rapid(80.0), table_m_s2=None)
    at_table = analyse_window(window, Identification()).at_table
    assert at_table is not None
    assert window.table_mm is not None
    unseen_um = 1e3 * np.abs(window.table_mm - window.position_mm)
    assert at_table.unseen_max_um == pytest.approx(unseen_um.max(), abs=3.0)  # the zero is at standstill
    assert at_table.error_rms_um > at_table.unseen_rms_um > 5.0
    assert analyse_window(replace(window, table_mm=None), Identification()).at_table is None


@pytest.mark.parametrize(("kind", "name"), sampled(product(KINDS, ["table_mm", "table_m_s2"]), every=3))
def test_arbitrary_sensor_signals_do_not_break_the_analysis(name: str, kind: str) -> None:
    window = simulate_table_rapid(80.0)
    values = {
        "constant": np.zeros(window.n),
        "nan": np.full(window.n, np.nan),
        "huge": 1e200 * np.sin(np.arange(window.n)),
        "infinite": np.where(np.arange(window.n) % 50 == 0, np.inf, window.position_mm),
        "motor": window.position_mm,
        "steps": np.round(window.position_mm, 0),
    }[kind]
    reported = replace(window, table_mm=freeze_array(values) if name == "table_mm" else None)
    outcome = analyse_window(
        replace(reported, table_m_s2=freeze_array(values) if name != "table_mm" else None), Identification()
    )
    assert outcome.estimate is not None
    assert outcome.estimate.get_value("Jt") == pytest.approx(TRUE.Jt, rel=0.05)
