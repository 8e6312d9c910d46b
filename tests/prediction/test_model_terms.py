"""Variants of a model: bands, torques, term families."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.prediction.inverse_dynamics import required
from fdhil.prediction.model_terms import band, linear, put_back, resisting, without_dry_friction
from fdhil.records import Parameters
from tests.bench import bench_config

BASE = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
RICH = BASE.replace_values(
    load=2.0,
    coulomb_positive=6.0,
    coulomb_negative=4.0,
    viscous_positive=0.06,
    viscous_negative=0.04,
    stribeck=1.0,
    stribeck_speed=10.0,
    ripple_screw_2=0.5,
    ripple_screw_2_phase=np.pi / 2,
    dead_time=1.0,
    resonance=80.0,
)


def test_the_band_that_holds_a_shaft_is_what_the_torques_leave() -> None:
    """Load and ripple shift the band, different friction by direction makes it asymmetric: -2.5 to 9.5 N.m here."""
    found = band(RICH, 0.0)
    assert found == pytest.approx((2.5 - 5.0, 2.5 + 7.0))
    assert found.middle == pytest.approx(3.5)
    assert found.holds(np.array([-2.6, -2.4, 9.4, 9.6]), 1.0).tolist() == [False, True, True, False]
    assert band(BASE, 1.0) == (-5.0, 5.0)


def test_the_torque_against_motion_is_the_sum_of_its_terms() -> None:
    speed, angle = np.array([20.0, -5.0, 0.0]), np.array([0.3, 1.0, 2.0])
    smooth, dry = resisting(RICH, speed, angle)
    ripple = 0.5 * np.sin(2 * angle + np.pi / 2)
    assert smooth == pytest.approx(2.0 + ripple + np.array([0.06 * 20.0, 0.04 * -5.0, 0.0]))
    assert dry == pytest.approx([6.0 + np.exp(-4.0), -(4.0 + np.exp(-0.25)), 0.0])
    smooth, dry = resisting(BASE, speed, angle)
    assert smooth + dry == pytest.approx(0.05 * speed + 5.0 * np.sign(speed))


def test_what_a_path_demands_has_the_terms_in_it() -> None:
    axis = bench_config().axis["X"]
    path = np.linspace(0.0, 100.0, 1001)
    amperes = [required(path, model, axis, 0.001)[0][500] * 200.0 for model in (BASE, BASE.replace_values(load=2.0))]
    assert amperes[1] - amperes[0] == pytest.approx(2.0 / 0.8)


def test_the_linear_part_keeps_what_is_linear() -> None:
    found = linear(RICH, 3.0)
    assert found.ft == pytest.approx(0.05)
    assert found.Cd == 3.0
    assert found.terms == (("resonance", 80.0),)


def test_without_dry_friction_the_rest_stays() -> None:
    found = without_dry_friction(RICH)
    assert found.Cd == 0.0
    assert {name for name, _ in found.terms} == {name for name, _ in RICH.terms} - {
        "coulomb_positive", "coulomb_negative", "stribeck", "stribeck_speed",
    }  # fmt: skip


def test_a_term_is_put_back_as_a_whole() -> None:
    names = ("stribeck", "stribeck_speed")
    assert put_back(RICH, BASE, names).get_term("stribeck") == 0.0
    assert put_back(RICH, BASE, names).get_term("stribeck_speed") == 10.0
    assert dict(put_back(BASE, RICH, names).terms) == {"stribeck": 1.0, "stribeck_speed": 10.0}
