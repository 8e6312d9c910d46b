"""Prediction and correction with additional model terms, on a plant that shares no numerics with the model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fdhil.correction import plan_correction
from fdhil.correction.block_streaming import stream_blocks
from fdhil.prediction import compute_contour_error_um
from fdhil.prediction.axis_models import apply_loops
from fdhil.records import Float, Parameters, Trajectory
from studies import real_plant
from studies.real_plant import Loops, Mechanics
from tests.bench import bench_config
from tests.paths import build_bench_trajectory, compute_rms
from tests.tiers import sampled

CONFIG = bench_config()
PATH = build_bench_trajectory(10)
PLAIN = Parameters.from_mapping(Mechanics().truth())


def list_reasons(m: Mechanics) -> Parameters:
    terms: dict[str, float] = {}
    if m.load_nm:
        terms["load"] = m.load_nm
    if m.asymmetry:
        terms |= {"coulomb_positive": m.Cd * (1 + m.asymmetry), "coulomb_negative": m.Cd * (1 - m.asymmetry)}
    if m.static:
        terms |= {"stribeck": m.static * m.Cd, "stribeck_speed": m.static_speed_rad_s}
    if m.screw_ripple:
        terms |= {"ripple_screw_1": m.screw_ripple * m.Cd, "ripple_screw_1_phase": m.screw_phase}
    if m.motor_ripple_nm:
        terms |= {f"ripple_motor_{m.motor_order}": m.motor_ripple_nm}
    if m.resonance_hz:
        terms |= {"resonance": m.resonance_hz, "resonance_damping": m.damping, "resonance_share": m.table_share}
    return PLAIN.replace_values(**terms)


def simulate_cut(
    m: Mechanics, offset_um: Mapping[str, Float] | None = None, loops: Loops | None = None, path: Trajectory = PATH
) -> Float:
    """Return the contour error (n,) at the table; at rest the axes hold the current that load and ripple need."""
    positions = []
    for axis, demand in path.position_mm.items():
        angle = demand[0] / m.pitch_m / 1e3 * 2 * np.pi
        held = (m.load_nm + m.Cd * m.screw_ripple * np.sin(angle + m.screw_phase)) / m.K
        start = np.array([held, 0.0, angle, 0.0, angle, held, m.R * held])
        ordered = demand + (0.0 if offset_um is None else offset_um[axis] * 1e-3)
        positions.append(real_plant.simulate_axis(m, ordered * 1e-3, loops, start=start).table_m * 1e3)
    return compute_contour_error_um(path.path_mm, np.column_stack(positions), 0.001)


EFFECTS: Mapping[str, tuple[dict[str, Any], float]] = {
    "nothing": ({}, 250),
    "falling friction": ({"static": 0.3}, 120),
    "rising friction": ({"static": -0.25, "static_speed_rad_s": 20.0}, 180),
    "friction by direction": ({"asymmetry": 0.2}, 250),
    "screw ripple": ({"screw_ripple": 0.1, "screw_phase": 1.0}, 250),
    "motor ripple": ({"motor_ripple_nm": 0.4}, 200),
    "load": ({"load_nm": 15.0}, 250),
    "resonance": ({"resonance_hz": 80.0}, 80),
    "all": (
        {"static": 0.2, "asymmetry": 0.05, "screw_ripple": 0.05, "resonance_hz": 120.0},
        80,
    ),
}


@pytest.mark.parametrize("effect", sampled([*EFFECTS][::-1], every=4))
def test_model_terms_are_predicted_and_corrected(effect: str) -> None:
    changes, least = EFFECTS[effect]
    plant = replace(Mechanics(), **changes)
    model = list_reasons(plant)
    correction = plan_correction(PATH, {"X": model, "Y": model}, CONFIG)
    assert correction.refused == ()
    before, after = simulate_cut(plant), simulate_cut(plant, correction.offset_um)
    assert np.abs(correction.before.contour_um - before).max() < 0.1
    assert compute_rms(before) > least * compute_rms(after)
    assert (after - before).max() < 1.0


@pytest.mark.usefixtures("long_computation")
@pytest.mark.parametrize("hertz", [50.0, 80.0])
def test_inexact_configured_resonance_is_tolerated(hertz: float) -> None:
    """15 % off in either direction: far better than without, where a fifth of the path gets worse."""
    plant = replace(Mechanics(), resonance_hz=hertz)
    before = simulate_cut(plant)
    blind = simulate_cut(plant, plan_correction(PATH, {"X": PLAIN, "Y": PLAIN}, CONFIG).offset_um)
    assert np.mean(blind > before + 1.0) > 0.15
    for share in (0.85, 1.15):
        model = PLAIN.replace_values(resonance=share * hertz, resonance_damping=0.03)
        after = simulate_cut(plant, plan_correction(PATH, {"X": model, "Y": model}, CONFIG).offset_um)
        assert compute_rms(after) < 0.45 * compute_rms(blind)


def test_resonance_beyond_reach_is_reported() -> None:
    """No offset within the limits compensates the table's oscillation at 20 Hz."""
    model = PLAIN.replace_values(resonance=20.0, resonance_damping=0.03)
    refused = plan_correction(PATH, {"X": model, "Y": model}, CONFIG).refused
    assert {reason.code for reason in refused} == {"ResonanceBeyondReach"}
    assert "at 20 Hz" in refused[0].text


def test_identified_loops_are_used() -> None:
    """A speed feedback filter of 1 ms that is not configured costs everything; identified, nothing."""
    loops = Loops(speed_filter_s=1e-3)
    known = apply_loops(CONFIG, {axis: {"speed_filter_s": 1e-3} for axis in "XY"}, "loops")
    models = {"X": PLAIN, "Y": PLAIN}
    before = simulate_cut(Mechanics(), None, loops)
    blind, seeing = (
        simulate_cut(Mechanics(), plan_correction(PATH, models, config).offset_um, loops) for config in (CONFIG, known)
    )
    assert compute_rms(before) < 5 * compute_rms(blind)
    assert compute_rms(before) > 200 * compute_rms(seeing)


def test_streamed_terms_equal_planned_terms() -> None:
    model = list_reasons(replace(Mechanics(), load_nm=5.0, static=0.2, asymmetry=0.1))
    models = {"X": model, "Y": model}
    whole = plan_correction(PATH, models, CONFIG)
    block = next(stream_blocks(iter([PATH.position_mm]), models, CONFIG))
    for axis in "XY":
        assert np.array_equal(block.offset_um[axis], whole.offset_um[axis][: block.before_um.size])
