"""Variants of a model: bands, torques, term families."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.prediction.inverse_dynamics import compute_required_shares
from fdhil.prediction.model_variants import (
    compute_friction_band,
    linearise_model,
    remove_dry_friction,
    restore_earlier_values,
    split_resisting_torque,
)
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


def test_friction_band_follows_from_torques() -> None:
    """Load and ripple shift the band, different friction by direction makes it asymmetric: -2.5 to 9.5 N.m here."""
    found = compute_friction_band(RICH, 0.0)
    assert found == pytest.approx((2.5 - 5.0, 2.5 + 7.0))
    assert found.middle == pytest.approx(3.5)
    assert found.is_holding(np.array([-2.6, -2.4, 9.4, 9.6]), 1.0).tolist() == [False, True, True, False]
    assert compute_friction_band(BASE, 1.0) == (-5.0, 5.0)


def test_resisting_torque_is_sum_of_terms() -> None:
    speed, angle = np.array([20.0, -5.0, 0.0]), np.array([0.3, 1.0, 2.0])
    smooth, dry = split_resisting_torque(RICH, speed, angle)
    ripple = 0.5 * np.sin(2 * angle + np.pi / 2)
    assert smooth == pytest.approx(2.0 + ripple + np.array([0.06 * 20.0, 0.04 * -5.0, 0.0]))
    assert dry == pytest.approx([6.0 + np.exp(-4.0), -(4.0 + np.exp(-0.25)), 0.0])
    smooth, dry = split_resisting_torque(BASE, speed, angle)
    assert smooth + dry == pytest.approx(0.05 * speed + 5.0 * np.sign(speed))


def test_required_current_includes_terms() -> None:
    axis = bench_config().axis["X"]
    path = np.linspace(0.0, 100.0, 1001)
    amperes = [
        compute_required_shares(path, model, axis, 0.001)[0][500] * 200.0
        for model in (BASE, BASE.replace_values(load=2.0))
    ]
    assert amperes[1] - amperes[0] == pytest.approx(2.0 / 0.8)


def test_linear_model_keeps_linear_terms() -> None:
    found = linearise_model(RICH, 3.0)
    assert found.ft == pytest.approx(0.05)
    assert found.Cd == 3.0
    assert found.terms == (("resonance", 80.0),)


def test_removing_dry_friction_keeps_other_terms() -> None:
    found = remove_dry_friction(RICH)
    assert found.Cd == 0.0
    assert {name for name, _ in found.terms} == {name for name, _ in RICH.terms} - {
        "coulomb_positive", "coulomb_negative", "stribeck", "stribeck_speed",
    }  # fmt: skip


def test_term_is_restored_as_whole() -> None:
    names = ("stribeck", "stribeck_speed")
    assert restore_earlier_values(RICH, BASE, names).get_term("stribeck") == 0.0
    assert restore_earlier_values(RICH, BASE, names).get_term("stribeck_speed") == 10.0
    assert dict(restore_earlier_values(BASE, RICH, names).terms) == {"stribeck": 1.0, "stribeck_speed": 10.0}
