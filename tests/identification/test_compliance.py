"""A compliant screw seen from the table: an independent plant of known resonance, encoder and accelerometer."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest

from fdhil.config import Identification
from fdhil.identification.compliance import TERMS, Compliance, beside_the_config, compliance, joined
from fdhil.identification.signals import mended
from fdhil.identification.windows import find_windows
from fdhil.pipeline import analyse
from fdhil.records import Float, Parameters, Window, freeze_array
from studies import real_plant
from studies.bench import shuttle
from studies.real_plant import Mechanics, Sensors
from tests.bench import bench_config
from tests.tiers import sampled

DT_S = 1e-3
TRUE = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
KINDS = ("constant", "nan", "huge", "infinite", "motor", "steps")
DAMPING, SHARE = 0.02, 0.6  # of the plant


def accelerations(mechanics: Mechanics, demand_m: Float, rows: int) -> Float:
    """Return the table's acceleration, averaged about each sample, from a run whose samples are steps of the
    simulation.
    """
    fine = real_plant.run(mechanics, demand_m, None, real_plant.STEP_S).table_m
    every = round(DT_S / real_plant.STEP_S)
    steps = np.gradient(np.gradient(fine, real_plant.STEP_S), real_plant.STEP_S)
    return np.convolve(steps, np.ones(every) / every, "same")[::every][:rows]


@cache
def rapid(hertz: float, seed: int = 1) -> Window:
    """Return a rapid of an axis with this resonance (0: rigid), with both table sensors and noise."""
    mechanics, demand_m = Mechanics(resonance_hz=hertz), shuttle()
    run = real_plant.run(mechanics, demand_m, None, DT_S)
    sensors = Sensors(noise=0.001, speed="difference")
    rng = np.random.default_rng(seed)
    table_mm = np.round(1e3 * run.table_m + 5e-5 * rng.standard_normal(run.table_m.size), 4)
    pushed = accelerations(mechanics, demand_m, table_mm.size) + 0.3 + 0.05 * rng.standard_normal(table_mm.size)
    recording = replace(
        real_plant.recording(run, mechanics, sensors, 0.5, seed),
        table_mm=freeze_array(table_mm),
        table_m_s2=freeze_array(pushed),
    )
    (window,) = find_windows(recording)
    return window


def seen(window: Window, **changes: Float | None) -> Compliance | None:
    return compliance(mended(replace(window, **changes)), TRUE)  # type: ignore[arg-type]


def within(found: Compliance | None, hertz: float, deviations: float = 3.0) -> None:
    assert found is not None
    std = np.sqrt(np.diag(found.covariance))
    assert np.all(np.abs(found.values - np.array([hertz, DAMPING, SHARE])) < deviations * std), (found.values, std)


@pytest.mark.parametrize("hertz", sampled([80.0, 50.0, 120.0], every=3))
def test_an_encoder_tells_resonance_damping_and_share(hertz: float) -> None:
    found = seen(rapid(hertz), table_m_s2=None)
    within(found, hertz)
    assert found is not None
    held_hz = found.values[0] * math.sqrt(1 - found.values[2])  # the deflection of the screw: determined much better
    assert held_hz == pytest.approx(hertz * math.sqrt(1 - SHARE), rel=2e-3)
    assert math.sqrt(found.covariance[0, 0]) < 0.1 * hertz


@pytest.mark.parametrize("hertz", [50.0, 80.0])
def test_an_accelerometer_tells_resonance_and_damping(hertz: float) -> None:
    found = seen(rapid(hertz), table_mm=None)
    within(found, hertz)
    assert found is not None
    assert found.values[0] == pytest.approx(hertz, rel=0.05)


def test_the_gain_of_an_accelerometer_and_its_lateness_do_not_matter() -> None:
    window = rapid(50.0)
    assert window.table_m_s2 is not None
    found = seen(window, table_mm=None, table_m_s2=freeze_array(1.05 * np.roll(window.table_m_s2, 2)))
    within(found, 50.0)
    assert found is not None
    assert found.late_s == pytest.approx(2e-3, abs=5e-4)


def test_a_stiff_screw_is_given_no_spring() -> None:
    assert seen(rapid(0.0), table_m_s2=None) is None
    assert seen(rapid(0.0), table_mm=None) is None


def test_nothing_is_told_without_a_sensor_or_of_one_that_lost_most() -> None:
    window = rapid(80.0)
    assert window.table_mm is not None
    lost = window.table_mm.copy()
    lost[::3] = np.nan
    assert seen(window, table_mm=None, table_m_s2=None) is None
    assert seen(window, table_mm=freeze_array(lost), table_m_s2=None) is None


def test_a_sensor_of_something_else_is_no_table() -> None:
    noise = np.random.default_rng(3).standard_normal(rapid(80.0).n)
    assert seen(rapid(80.0), table_mm=freeze_array(noise), table_m_s2=None) is None
    assert seen(rapid(80.0), table_mm=None, table_m_s2=freeze_array(noise)) is None


def test_it_joins_the_estimate_with_the_doubt_that_windows_share() -> None:
    outcome = analyse(replace(rapid(80.0), table_m_s2=None), Identification())
    estimate = outcome.estimate
    assert estimate is not None
    assert set(TERMS) <= set(estimate.terms)
    assert estimate.get_value("resonance") == pytest.approx(80.0, rel=0.1)
    assert estimate.systematic is not None
    assert estimate.systematic.shape[0] == len(estimate.names) == estimate.covariance.shape[0]
    found = seen(rapid(50.0), table_m_s2=None)
    assert found is not None
    again = joined(estimate, found)  # it replaces the first one
    assert again.names == estimate.names
    assert again.get_value("resonance") == pytest.approx(50.0, rel=0.1)


@pytest.mark.usefixtures("real_time")
@pytest.mark.parametrize(("configured", "codes"), [(None, []), (80.0, []), (60.0, ["ResonanceDiffers"])])
def test_a_configuration_that_says_otherwise_is_warned_of(configured: float | None, codes: list[str]) -> None:
    found = seen(rapid(80.0), table_m_s2=None)
    assert found is not None
    axis = bench_config("X").axis["X"].model_copy(update={"resonance_hz": configured})
    told = beside_the_config(found, axis)
    assert [reason.code for reason in told] == codes
    assert all("60 Hz" in reason.text for reason in told)
    assert beside_the_config(found, None) == []


@pytest.mark.usefixtures("real_time")
def test_the_table_s_true_error_is_told() -> None:
    window = replace(rapid(80.0), table_m_s2=None)
    at_table = analyse(window, Identification()).at_table
    assert at_table is not None
    assert window.table_mm is not None
    unseen_um = 1e3 * np.abs(window.table_mm - window.position_mm)
    assert at_table.unseen_max_um == pytest.approx(unseen_um.max(), abs=3.0)  # the zero is at standstill
    assert at_table.error_rms_um > at_table.unseen_rms_um > 5.0
    assert analyse(replace(window, table_mm=None), Identification()).at_table is None


@pytest.mark.parametrize(("kind", "name"), sampled(product(KINDS, ["table_mm", "table_m_s2"]), every=3))
def test_whatever_a_sensor_tells_the_window_is_analysed(name: str, kind: str) -> None:
    window = rapid(80.0)
    values = {
        "constant": np.zeros(window.n),
        "nan": np.full(window.n, np.nan),
        "huge": 1e200 * np.sin(np.arange(window.n)),
        "infinite": np.where(np.arange(window.n) % 50 == 0, np.inf, window.position_mm),
        "motor": window.position_mm,
        "steps": np.round(window.position_mm, 0),
    }[kind]
    told = replace(window, table_mm=freeze_array(values) if name == "table_mm" else None)
    outcome = analyse(replace(told, table_m_s2=freeze_array(values) if name != "table_mm" else None), Identification())
    assert outcome.estimate is not None
    assert outcome.estimate.get_value("Jt") == pytest.approx(TRUE.Jt, rel=0.05)
