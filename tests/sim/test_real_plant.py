"""Effects of real axes: against the studies' plant, an integration by scipy, and invariants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fdhil.config import Reality
from fdhil.records import Float, Parameters
from fdhil.sim.drive import real_plant_kernels
from fdhil.sim.drive.plant_physics import PlantPhysics
from fdhil.sim.drive.real_plant import RealPlantPhysics
from studies import real_plant
from studies.real_plant import Loops, Mechanics
from tests.sim.test_plant_physics import AXIS, INC, PLANT, build_command, build_rapid_mm, list_points

RAD_PER_MM = 2 * np.pi / 20
FINE = 2**30  # increments: the other plant's loops know no encoder
UM_PER_RAD = 1e3 / RAD_PER_MM
RAMP: Float = np.linspace(0.0, 59.9, 600)  # mm: 100 mm/s for ever
REST = build_command((0.0, 0.0, 0.0))


def build_axis(
    *, plant: Parameters = PLANT, increments: int = INC, backlash_um: float = 0.0, start_mm: float = 0.0, **keys: Any
) -> RealPlantPhysics:
    return RealPlantPhysics(
        plant,
        AXIS.regulators,
        1e-3,
        increments,
        Reality(**keys),
        rad_per_mm=RAD_PER_MM,
        angle_rad=start_mm * RAD_PER_MM,
        backlash_rad=backlash_um * 1e-3 * RAD_PER_MM,
    )


def build_reversal(n: int = 640) -> Float:
    """Return a demand (n,) in mm that moves up to 250 mm/s both ways and rests at its end."""
    t = np.arange(n) * 1e-3
    return np.where(t < 0.5, 20.0 * (1 - np.cos(2 * np.pi * t / 0.5)), 0.0)


def cut_path(physics: PlantPhysics, demand_mm: Float, increments: int = INC) -> Float:
    """Return (n, 5): motor and table in mm, speed and current at the start of each cycle, mean voltage in it."""
    rows = []
    for points in list_points(demand_mm * increments / INC):
        before = [physics.angle_rad / RAD_PER_MM, physics.table_rad / RAD_PER_MM]
        before += [physics.speed_rad_s, physics.current_a]
        physics.run_cycle(True, build_command(points))
        rows.append([*before, physics.voltage_mean_v])
    return np.array(rows)


# -- against other plants


def test_real_plant_without_effects_equals_plain_plant() -> None:
    plain, real = (
        PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC, backlash_rad=1e-4),
        build_axis(backlash_um=1e-1 / RAD_PER_MM),
    )
    away = cut_path(plain, build_rapid_mm()) - cut_path(real, build_rapid_mm())
    assert np.abs(away[:, :2]).max() < 0.05e-3  # mm
    for machine in (plain, real):
        machine.load_torque_nm = 5.2
        for _ in range(30):
            machine.run_cycle(False, REST)
    assert real.speed_rad_s == pytest.approx(plain.speed_rad_s, rel=1e-3)


@pytest.mark.parametrize(
    ("keys", "mechanics", "loops"),
    [
        pytest.param({"static_friction": 0.3}, {"static": 0.3}, {}, id="stribeck"),
        pytest.param(
            {"static_friction": -0.2, "static_speed_rad_s": 20.0},
            {"static": -0.2, "static_speed_rad_s": 20.0},
            {},
            id="rising friction",
        ),
        pytest.param({"friction_asymmetry": 0.1, "load_nm": 2.5}, {"asymmetry": 0.1, "load_nm": 2.5}, {}, id="load"),
        pytest.param(
            {"screw_ripple_nm": 0.5, "screw_ripple_phase_rad": 1.0, "motor_ripple_nm": 0.4},
            {"screw_ripple": 0.1, "screw_phase": 1.0, "motor_ripple_nm": 0.4},
            {},
            id="ripples",
        ),
        pytest.param(
            {"resonance_hz": 80.0, "position_encoder": "motor", "table_friction": 1.0},
            {"resonance_hz": 80.0},
            {},
            id="compliance",
        ),
        pytest.param({"resonance_hz": 80.0}, {"resonance_hz": 80.0}, {"table_scale": True}, id="scale at the table"),
        pytest.param({"dead_time_v": 4.0}, {}, {"dead_time_v": 4.0}, id="dead time"),
        pytest.param({"bus_sag": 0.1, "bus_time_constant_s": 0.0}, {}, {"bus_sag": 0.1}, id="bus sag"),
        pytest.param({"speed_filter_s": 1e-3}, {}, {"speed_filter_s": 1e-3}, id="filter of the speed"),
        pytest.param({"current_delay_cycles": 4}, {}, {"delay_s": 1.25e-4}, id="computing delay"),
    ],
)
def test_real_plant_matches_independent_plant_with_same_effect(
    keys: dict[str, Any], mechanics: dict[str, Any], loops: dict[str, Any]
) -> None:
    # viscous friction acts at the motor in the other plant: taken out of both, where there are two masses
    plant = replace(PLANT, ft=0.0) if "resonance_hz" in keys else PLANT
    start = np.zeros(7)
    demand = build_reversal()
    other = real_plant.simulate_axis(Mechanics(**mechanics, ft=plant.ft), demand / 1e3, Loops(**loops), start=start)
    got, without = (cut_path(build_axis(plant=plant, increments=FINE, **k), demand, FINE) for k in (keys, {}))
    away_um = 1e3 * np.abs(got[:, :2] - 1e3 * np.column_stack([other.motor_m, other.table_m]))
    meant_um = 1e3 * np.abs(got[:, :2] - without[:, :2]).max()
    assert away_um.max() < 0.05
    assert meant_um > 5 * away_um.max()
    assert np.abs(got[:, 3] - other.current).max() < 0.05
    assert np.abs(got[:, 4] - other.voltage).max() < 0.15


def test_bristles_follow_lugre_equation() -> None:
    """One mass on LuGre bristles under an oscillating load, against scipy's stiff integrator."""
    machine = build_axis(presliding_um=20.0, static_friction=0.2)
    p = machine._p
    s0 = p[real_plant_kernels.BRISTLES] * PLANT.Cd
    s1 = np.sqrt(s0 * PLANT.Jt)
    loads = 7.0 * np.sin(2 * np.pi * 2 * np.arange(600) * 1e-3)

    def compute_derivative(t: float, y: Float) -> list[float]:
        w, _, z = y
        level = PLANT.Cd * (1 + 0.2 * np.exp(-((w / 10.0) ** 2)))
        slip = w - s0 * abs(w) * z / level
        push = -loads[min(int(t * 1e3), loads.size - 1)]
        return [(push - s0 * z - s1 * slip - PLANT.ft * w) / PLANT.Jt, w, slip]

    angles = []
    for load in loads:
        angles.append(machine.angle_rad)
        machine.load_torque_nm = float(load)
        machine.run_cycle(False, REST)
    times = np.arange(loads.size) * 1e-3
    other = solve_ivp(
        compute_derivative, (0.0, times[-1]), [0.0, 0.0, 0.0], "LSODA", times, rtol=1e-8, atol=1e-11, max_step=1e-3
    )
    assert np.ptp(angles) > 10 * p[real_plant_kernels.BRISTLES] ** -1  # it broke away
    assert np.abs(angles - other.y[1]).max() * UM_PER_RAD < 0.02 * np.ptp(angles) * UM_PER_RAD


# -- what must hold by itself


def test_presliding_is_elastic_below_friction() -> None:
    machine = build_axis(presliding_um=20.0)
    places = []
    for load in np.concatenate([np.linspace(0, -2.5, 2000), np.linspace(-2.5, 0, 2000)]):
        machine.load_torque_nm = float(load)
        machine.run_cycle(False, REST)
        places.append(machine.angle_rad * UM_PER_RAD)
    # dF/dx = s0 (1 - F/C): 2.5 of 5 N.m are there after ln 2 of the way; unloading is as stiff as at the start
    assert places[1999] == pytest.approx(20.0 * np.log(2), rel=0.05)
    assert places[-1] == pytest.approx(20.0 * (np.log(2) - np.log(1.5)), abs=1.5)


def test_load_falls_without_brake_and_is_held_by_brake() -> None:
    free, held = build_axis(load_nm=8.0), build_axis(load_nm=8.0, brake_nm=6.0)
    for _ in range(100):
        free.run_cycle(False, REST)
        held.run_cycle(False, REST)
    assert free.angle_rad < -0.1
    assert held.angle_rad == 0.0
    for _ in range(600):
        held.run_cycle(True, REST)
    assert held.current_a > 3.0 / PLANT.K - 0.2  # the regulators hold what friction does not
    assert abs(held.angle_rad) * UM_PER_RAD < 1.0


def test_drive_direction_reverses_signs() -> None:
    keys: dict[str, Any] = {"load_nm": 1.0, "friction_asymmetry": 0.2, "viscous_asymmetry": 0.1, "friction_ripple": 0.1}
    keys |= {"screw_ripple_nm": 0.5, "screw_ripple_phase_rad": 0.7, "pitch_error_um": 3.0, "pitch_error_um_per_m": 50.0}
    ahead = build_axis(**keys)
    back = RealPlantPhysics(PLANT, AXIS.regulators, 1e-3, INC, Reality(**keys), rad_per_mm=-RAD_PER_MM)
    demand = build_reversal()
    for points, turned in zip(list_points(demand), list_points(-demand), strict=True):
        ahead.run_cycle(True, build_command(points))
        back.run_cycle(True, build_command(turned))
    np.testing.assert_allclose(back.table_rad, -ahead.table_rad, atol=1e-9)
    np.testing.assert_allclose(back.current_a, -ahead.current_a, atol=1e-6)


def test_compliant_screw_deflects_and_has_backlash() -> None:
    """The motor encoder is at its demand; the table lags by spring and backlash."""
    machine = build_axis(resonance_hz=60.0, backlash_um=30.0, position_encoder="motor", load_nm=4.0, brake_nm=20.0)
    for points in list_points(np.append(np.linspace(0, 5, 400), np.full(800, 5.0))):
        machine.run_cycle(True, build_command(points))
    stiffness = machine._p[real_plant_kernels.STIFFNESS]
    hangs_um = (machine.angle_rad - machine.table_rad) * UM_PER_RAD
    assert abs(machine.angle_rad / RAD_PER_MM - 5.0) < 1e-3
    least, most = (4.0 - 5.0) / stiffness * UM_PER_RAD, (4.0 + 5.0) / stiffness * UM_PER_RAD  # friction holds between
    assert 15.0 + least < hangs_um < 15.0 + most


def test_pitch_error_is_at_table_and_scale_removes_it() -> None:
    keys: dict[str, Any] = {"pitch_error_um": 4.0, "pitch_error_um_per_m": 100.0}
    by_motor, by_scale = build_axis(position_encoder="motor", **keys), build_axis(**keys)
    for points in list_points(np.append(np.linspace(0, 5, 300), np.full(300, 5.0))):
        by_motor.run_cycle(True, build_command(points))
        by_scale.run_cycle(True, build_command(points))
    assert by_motor.table_rad * UM_PER_RAD - 5e3 == pytest.approx(4.0 + 0.5, abs=0.3)  # a quarter turn; 5 mm of 1 m
    assert by_scale.table_rad * UM_PER_RAD - 5e3 == pytest.approx(0.0, abs=0.3)


def test_voltage_object_and_current_sensor_have_their_errors() -> None:
    machine = build_axis(
        dead_time_v=4.0, voltage_object="command", current_gain=1.02, current_offset_a=0.5, voltage_gain=0.9
    )
    for points in list_points(build_reversal())[:40]:
        machine.run_cycle(True, build_command(points))
    assert machine.current_a > 20.0
    assert machine.sensed.voltage_v == pytest.approx(0.9 * (machine.voltage_mean_v + 4.0), rel=1e-6)
    assert machine.sensed.current_a == pytest.approx(1.02 * machine.current_a + 0.5)


def test_dc_link_sags_with_power() -> None:
    stiff, soft = (
        build_axis(voltage_object="command"),
        build_axis(voltage_object="command", bus_sag=0.1, bus_power_kw=1.0),
    )
    rows = []
    for points in list_points(RAMP)[:400]:
        stiff.run_cycle(True, build_command(points))
        soft.run_cycle(True, build_command(points))
        rows.append([soft.voltage_mean_v, soft.sensed.voltage_v, soft.current_a, stiff.voltage_mean_v])
    got_v, asked_v, current_a, needed_v = np.mean(rows[200:], axis=0)  # at one speed
    assert got_v / asked_v == pytest.approx(1 - 0.1 * got_v * current_a / 1e3, abs=1e-3)
    assert asked_v > 1.02 * got_v
    assert got_v == pytest.approx(needed_v, abs=0.05)


def test_encoder_difference_speed_is_delayed_and_quantised() -> None:
    machine = build_axis(encoder_bits=13, speed_object="difference")
    reported, true = [], []
    for points in list_points(build_reversal()):
        machine.run_cycle(True, build_command(points))
        reported.append(machine.sensed.speed_rad_s)
        true.append(machine.speed_rad_s)
    speed, shown = np.array(true), np.array(reported)
    quantum = 2 * np.pi / 2**13 / 1e-3
    assert np.abs(shown / quantum - np.rint(shown / quantum)).max() < 1e-6
    middle = (speed[:-1] + speed[1:]) / 2
    assert np.abs(shown[1:] - middle).max() < 1.1 * quantum
    lags = [np.sum((np.interp(np.arange(speed.size) - late, np.arange(speed.size), speed) - shown) ** 2)
            for late in np.linspace(0.0, 1.0, 21)]  # fmt: skip
    assert np.linspace(0.0, 1.0, 21)[int(np.argmin(lags))] == pytest.approx(0.5, abs=0.1)


def test_filtered_speed_object_lags_by_time_constant() -> None:
    machine = build_axis(speed_object_filter_s=5e-3)
    reported, true = [], []
    for points in list_points(build_reversal()[:200]):
        machine.run_cycle(True, build_command(points))
        reported.append(machine.sensed.speed_rad_s)
        true.append(machine.speed_rad_s)
    rate = np.gradient(true, 1e-3)
    late_s = (np.array(true) - reported)[50:100] @ rate[50:100] / (rate[50:100] @ rate[50:100])
    assert late_s == pytest.approx(5e-3, abs=0.5e-3)


def test_real_loops_may_differ_from_configured_ones() -> None:
    faster = build_axis(position_gain_per_s=100.0, speed_feedforward=0.0)
    slower = build_axis(speed_feedforward=0.0)
    lag = [RAMP[-1] - cut_path(machine, RAMP)[-1, 1] for machine in (faster, slower)]
    assert lag == pytest.approx([1.0, 2.0], rel=0.02)  # v / Kv


def test_coarse_encoder_feedback_causes_current_noise() -> None:
    quiet, stirred = (
        cut_path(build_axis(encoder_bits=14, speed_feedback=how), RAMP) for how in ("shaft", "difference")
    )
    assert np.std(stirred[300:, 3]) > 2 * np.std(quiet[300:, 3])
    assert abs(stirred[-1, 1] - quiet[-1, 1]) < 0.02


def test_setpoint_filter_delays_axis() -> None:
    regulators = AXIS.regulators.model_copy(update={"setpoint_filter_s": 0.01, "setpoint_filter_order": 2})
    machine = RealPlantPhysics(PLANT, regulators, 1e-3, INC, Reality(), rad_per_mm=RAD_PER_MM)
    assert RAMP[-1] - cut_path(machine, RAMP)[-1, 1] == pytest.approx(100.0 * 0.02, rel=0.02)  # two times 10 ms


def test_real_kernel_is_identical_to_plain_python(monkeypatch: pytest.MonkeyPatch) -> None:
    keys: dict[str, Any] = {"static_friction": 0.2, "presliding_um": 5.0, "friction_ripple": 0.05, "load_nm": 1.0,
            "screw_ripple_nm": 0.2, "motor_ripple_nm": 0.2, "resonance_hz": 90.0, "table_friction": 0.5,
            "pitch_error_um": 2.0, "dead_time_v": 1.0, "bus_sag": 0.03, "encoder_bits": 20,
            "speed_feedback": "difference", "setpoint_filter_s": 1e-3, "current_delay_cycles": 2}  # fmt: skip
    compiled, plain = build_axis(backlash_um=5.0, **keys), build_axis(backlash_um=5.0, **keys)
    rows = cut_path(compiled, build_reversal()[:40])
    for name, kernel in vars(real_plant_kernels).items():
        if hasattr(kernel, "py_func"):
            monkeypatch.setattr(real_plant_kernels, name, kernel.py_func)
    np.testing.assert_allclose(cut_path(plain, build_reversal()[:40]), rows, rtol=1e-7, atol=1e-7)
    for machine in (compiled, plain):
        machine.run_cycle(False, REST)


@pytest.mark.parametrize("presliding_um", [0.0, 0.5, 10.0])
@pytest.mark.parametrize("static_friction", [-0.5, 0.5])
@pytest.mark.parametrize("resonance_hz", [0.0, 40.0, 400.0])
def test_axis_follows_with_any_combination_of_effects(
    presliding_um: float, static_friction: float, resonance_hz: float
) -> None:
    machine = build_axis(
        backlash_um=10.0 if resonance_hz else 0.0,
        presliding_um=presliding_um,
        static_friction=static_friction,
        resonance_hz=resonance_hz,
        table_friction=0.5,
        position_encoder="motor",
    )
    rows = cut_path(machine, build_reversal())
    assert np.all(np.isfinite(rows))
    assert np.abs(rows[:, 0] - build_reversal()).max() < 0.3
    assert np.abs(rows[-1, 2]) < 1.0
