"""Effects of real axes in the simulator and in the model's terms: independent code that must agree on the path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fdhil import config as machine_config
from fdhil.config import MachineConfig
from fdhil.prediction import predict_path
from fdhil.program import load_trajectory
from fdhil.records import Float, Parameters
from tests.bench import bench_document
from tests.integration.test_prediction_agrees import PROGRAMS, table

pytestmark = pytest.mark.usefixtures("long_computation")

PROGRAM = PROGRAMS / "bench_10m.ngc"
STARTED = 500  # rows after which what the regulators held at the start no longer counts
REALITY = {
    "friction": {"static_friction": 0.3, "friction_asymmetry": 0.1, "viscous_asymmetry": 0.2, "load_nm": 2.5,
                 "screw_ripple_nm": 0.5, "screw_ripple_phase_rad": 1.0,
                 "motor_ripple_nm": 0.4, "motor_ripple_phase_rad": -0.5},
    "drive": {"dead_time_v": 4.0, "speed_filter_s": 1e-3, "current_delay_cycles": 8, "speed_kp": 20.0},
    "compliance": {"resonance_hz": 80.0, "position_encoder": "motor"},
}  # fmt: skip
TERMS: dict[str, dict[str, float]] = {
    "friction": {"stribeck": 1.5, "stribeck_speed": 10.0, "coulomb_positive": 5.5, "coulomb_negative": 4.5,
                 "viscous_positive": 0.06, "viscous_negative": 0.04, "load": 2.5,
                 "ripple_screw_1": 0.5, "ripple_screw_1_phase": 1.0,
                 "ripple_motor_24": 0.4, "ripple_motor_24_phase": -0.5},
    "drive": {"dead_time": 4.0},
    "compliance": {"resonance": 80.0, "resonance_damping": 0.02, "resonance_share": 0.6},
}  # fmt: skip
LOOPS: dict[str, dict[str, Any]] = {"drive": {"speed_filter_s": 1e-3, "current_delay_cycles": 8, "speed_kp": 20.0}}
PLANT = {"compliance": {"ft": 0.0}}  # behind the spring in the twin, before it in the model


def machine(case: str, *, told: bool) -> MachineConfig:
    document = bench_document()
    for axis in document["axis"].values():
        axis["regulators"] |= LOOPS.get(case, {}) if told else {}
        axis["nominal"] |= PLANT.get(case, {})
    quiet = {"voltage_v": 0.0, "current_a": 0.0, "speed_rad_s": 0.0}
    document["sim"] = {"noise": quiet, "modbus": False, "axis": {axis: {"reality": REALITY[case]} for axis in "XY"}}
    return machine_config.parse_config(document)


def predicted(config: MachineConfig, terms: dict[str, float]) -> Float:
    models = {axis: Parameters(**s.nominal.model_dump()).replace_values(**terms) for axis, s in config.axis.items()}
    answer = predict_path(load_trajectory(PROGRAM, config), models, config)
    return np.column_stack([answer.predicted_mm["X"], answer.predicted_mm["Y"]])


@pytest.mark.parametrize("case", REALITY)
def test_terms_match_the_simulator_within_an_increment(case: str, tmp_path: Path) -> None:
    untold = machine(case, told=False)
    actual = table(untold, PROGRAM, tmp_path)
    with_terms, without = predicted(machine(case, told=True), TERMS[case]), predicted(untold, {})
    rows = slice(STARTED, len(with_terms))
    away_um = 1e3 * np.abs(with_terms - actual[: len(with_terms)])[rows].max()
    meant_um = 1e3 * np.abs(without - actual[: len(with_terms)])[rows].max()
    assert away_um < 0.31
    assert meant_um > 10 * away_um
