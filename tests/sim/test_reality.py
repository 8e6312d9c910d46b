"""Effects of real axes: against the studies' plant, an integration by scipy, and invariants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fdhil.config import Reality
from fdhil.records import Float, Parameters
from fdhil.sim.drive import real_cycle
from fdhil.sim.drive.physics import Physics
from fdhil.sim.drive.reality import RealPhysics
from studies import real_plant
from studies.real_plant import Loops, Mechanics
from tests.sim.test_physics import AXIS, INC, PLANT, command, points_of, rapid_mm

RAD_PER_MM = 2 * np.pi / 20
FINE = 2**30  # increments: the other plant's loops know no encoder
UM_PER_RAD = 1e3 / RAD_PER_MM
RAMP: Float = np.linspace(0.0, 59.9, 600)  # mm: 100 mm/s for ever
REST = command((0.0, 0.0, 0.0))


def axis(
    *, plant: Parameters = PLANT, increments: int = INC, backlash_um: float = 0.0, start_mm: float = 0.0, **keys: Any
) -> RealPhysics:
    return RealPhysics(
        plant,
        AXIS.regulators,
        1e-3,
        increments,
        Reality(**keys),
        rad_per_mm=RAD_PER_MM,
        angle_rad=start_mm * RAD_PER_MM,
        backlash_rad=backlash_um * 1e-3 * RAD_PER_MM,
    )


def there_and_back(n: int = 640) -> Float:
    """Return a demand (n,) in mm that moves up to 250 mm/s both ways and rests at its end."""
    t = np.arange(n) * 1e-3
    return np.where(t < 0.5, 20.0 * (1 - np.cos(2 * np.pi * t / 0.5)), 0.0)


def cut(physics: Physics, demand_mm: Float, increments: int = INC) -> Float:
    """Return (n, 5): motor and table in mm, speed and current at the start of each cycle, mean voltage in it."""
    rows = []
    for points in points_of(demand_mm * increments / INC):
        before = [physics.angle_rad / RAD_PER_MM, physics.table_rad / RAD_PER_MM]
        before += [physics.speed_rad_s, physics.current_a]
        physics.cycle(True, command(points))
        rows.append([*before, physics.voltage_mean_v])
    return np.array(rows)


# -- against other plants


def test_with_everything_off_it_is_the_papers_plant() -> None:
    plain, real = Physics(PLANT, AXIS.regulators, 1e-3, INC, backlash_rad=1e-4), axis(backlash_um=1e-1 / RAD_PER_MM)
    away = cut(plain, rapid_mm()) - cut(real, rapid_mm())
    assert np.abs(away[:, :2]).max() < 0.05e-3  # mm
    for machine in (plain, real):
        machine.load_torque_nm = 5.2
        for _ in range(30):
            machine.cycle(False, REST)
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
def test_it_cuts_what_another_plant_with_the_same_effect_cuts(
    keys: dict[str, Any], mechanics: dict[str, Any], loops: dict[str, Any]
) -> None:
    # viscous friction acts at the motor in the other plant: taken out of both, where there are two masses
    plant = replace(PLANT, ft=0.0) if "resonance_hz" in keys else PLANT
    start = np.zeros(7)
    demand = there_and_back()
    other = real_plant.run(Mechanics(**mechanics, ft=plant.ft), demand / 1e3, Loops(**loops), start=start)
    got, without = (cut(axis(plant=plant, increments=FINE, **k), demand, FINE) for k in (keys, {}))
    away_um = 1e3 * np.abs(got[:, :2] - 1e3 * np.column_stack([other.motor_m, other.table_m]))
    meant_um = 1e3 * np.abs(got[:, :2] - without[:, :2]).max()
    assert away_um.max() < 0.05
    assert meant_um > 5 * away_um.max()
    assert np.abs(got[:, 3] - other.current).max() < 0.05
    assert np.abs(got[:, 4] - other.voltage).max() < 0.15


def test_bristles_follow_their_equation() -> None:
    """One mass on LuGre bristles under an oscillating load, against scipy's stiff integrator."""
    machine = axis(presliding_um=20.0, static_friction=0.2)
    p = machine._p
    s0 = p[real_cycle.BRISTLES] * PLANT.Cd
    s1 = np.sqrt(s0 * PLANT.Jt)
    loads = 7.0 * np.sin(2 * np.pi * 2 * np.arange(600) * 1e-3)

    def slope(t: float, y: Float) -> list[float]:
        w, _, z = y
        level = PLANT.Cd * (1 + 0.2 * np.exp(-((w / 10.0) ** 2)))
        slip = w - s0 * abs(w) * z / level
        push = -loads[min(int(t * 1e3), loads.size - 1)]
        return [(push - s0 * z - s1 * slip - PLANT.ft * w) / PLANT.Jt, w, slip]

    angles = []
    for load in loads:
        angles.append(machine.angle_rad)
        machine.load_torque_nm = float(load)
        machine.cycle(False, REST)
    times = np.arange(loads.size) * 1e-3
    other = solve_ivp(slope, (0.0, times[-1]), [0.0, 0.0, 0.0], "LSODA", times, rtol=1e-8, atol=1e-11, max_step=1e-3)
    assert np.ptp(angles) > 10 * p[real_cycle.BRISTLES] ** -1  # it broke away
    assert np.abs(angles - other.y[1]).max() * UM_PER_RAD < 0.02 * np.ptp(angles) * UM_PER_RAD


# -- what must hold by itself


def test_presliding_bends_and_springs_back_below_the_friction() -> None:
    machine = axis(presliding_um=20.0)
    places = []
    for load in np.concatenate([np.linspace(0, -2.5, 2000), np.linspace(-2.5, 0, 2000)]):
        machine.load_torque_nm = float(load)
        machine.cycle(False, REST)
        places.append(machine.angle_rad * UM_PER_RAD)
    # dF/dx = s0 (1 - F/C): 2.5 of 5 N.m are there after ln 2 of the way; unloading is as stiff as at the start
    assert places[1999] == pytest.approx(20.0 * np.log(2), rel=0.05)
    assert places[-1] == pytest.approx(20.0 * (np.log(2) - np.log(1.5)), abs=1.5)


def test_a_weight_falls_without_brake_and_is_held_by_one() -> None:
    free, held = axis(load_nm=8.0), axis(load_nm=8.0, brake_nm=6.0)
    for _ in range(100):
        free.cycle(False, REST)
        held.cycle(False, REST)
    assert free.angle_rad < -0.1
    assert held.angle_rad == 0.0
    for _ in range(600):
        held.cycle(True, REST)
    assert held.current_a > 3.0 / PLANT.K - 0.2  # the regulators hold what friction does not
    assert abs(held.angle_rad) * UM_PER_RAD < 1.0


def test_the_drives_direction_turns_the_axis_signs() -> None:
    keys: dict[str, Any] = {"load_nm": 1.0, "friction_asymmetry": 0.2, "viscous_asymmetry": 0.1, "friction_ripple": 0.1}
    keys |= {"screw_ripple_nm": 0.5, "screw_ripple_phase_rad": 0.7, "pitch_error_um": 3.0, "pitch_error_um_per_m": 50.0}
    ahead = axis(**keys)
    back = RealPhysics(PLANT, AXIS.regulators, 1e-3, INC, Reality(**keys), rad_per_mm=-RAD_PER_MM)
    demand = there_and_back()
    for points, turned in zip(points_of(demand), points_of(-demand), strict=True):
        ahead.cycle(True, command(points))
        back.cycle(True, command(turned))
    np.testing.assert_allclose(back.table_rad, -ahead.table_rad, atol=1e-9)
    np.testing.assert_allclose(back.current_a, -ahead.current_a, atol=1e-6)


def test_the_screw_gives_and_loses_motion() -> None:
    """The motor encoder is at its demand; the table lags by spring and backlash."""
    machine = axis(resonance_hz=60.0, backlash_um=30.0, position_encoder="motor", load_nm=4.0, brake_nm=20.0)
    for points in points_of(np.append(np.linspace(0, 5, 400), np.full(800, 5.0))):
        machine.cycle(True, command(points))
    stiffness = machine._p[real_cycle.STIFFNESS]
    hangs_um = (machine.angle_rad - machine.table_rad) * UM_PER_RAD
    assert abs(machine.angle_rad / RAD_PER_MM - 5.0) < 1e-3
    least, most = (4.0 - 5.0) / stiffness * UM_PER_RAD, (4.0 + 5.0) / stiffness * UM_PER_RAD  # friction holds between
    assert 15.0 + least < hangs_um < 15.0 + most


def test_the_screws_error_is_at_the_table_and_a_scale_takes_it_out() -> None:
    keys: dict[str, Any] = {"pitch_error_um": 4.0, "pitch_error_um_per_m": 100.0}
    by_motor, by_scale = axis(position_encoder="motor", **keys), axis(**keys)
    for points in points_of(np.append(np.linspace(0, 5, 300), np.full(300, 5.0))):
        by_motor.cycle(True, command(points))
        by_scale.cycle(True, command(points))
    assert by_motor.table_rad * UM_PER_RAD - 5e3 == pytest.approx(4.0 + 0.5, abs=0.3)  # a quarter turn; 5 mm of 1 m
    assert by_scale.table_rad * UM_PER_RAD - 5e3 == pytest.approx(0.0, abs=0.3)


def test_the_voltage_object_and_the_sensors_tell_their_own_story() -> None:
    machine = axis(dead_time_v=4.0, voltage_object="command", current_gain=1.02, current_offset_a=0.5, voltage_gain=0.9)
    for points in points_of(there_and_back())[:40]:
        machine.cycle(True, command(points))
    assert machine.current_a > 20.0
    assert machine.seen.voltage_v == pytest.approx(0.9 * (machine.voltage_mean_v + 4.0), rel=1e-6)
    assert machine.seen.current_a == pytest.approx(1.02 * machine.current_a + 0.5)


def test_the_bus_falls_with_the_power_drawn() -> None:
    stiff, soft = axis(voltage_object="command"), axis(voltage_object="command", bus_sag=0.1, bus_power_kw=1.0)
    rows = []
    for points in points_of(RAMP)[:400]:
        stiff.cycle(True, command(points))
        soft.cycle(True, command(points))
        rows.append([soft.voltage_mean_v, soft.seen.voltage_v, soft.current_a, stiff.voltage_mean_v])
    got_v, asked_v, current_a, needed_v = np.mean(rows[200:], axis=0)  # at one speed
    assert got_v / asked_v == pytest.approx(1 - 0.1 * got_v * current_a / 1e3, abs=1e-3)
    assert asked_v > 1.02 * got_v
    assert got_v == pytest.approx(needed_v, abs=0.05)


def test_a_speed_of_encoder_positions_is_half_a_row_late_and_coarse() -> None:
    machine = axis(encoder_bits=13, speed_object="difference")
    told, true = [], []
    for points in points_of(there_and_back()):
        machine.cycle(True, command(points))
        told.append(machine.seen.speed_rad_s)
        true.append(machine.speed_rad_s)
    speed, shown = np.array(true), np.array(told)
    quantum = 2 * np.pi / 2**13 / 1e-3
    assert np.abs(shown / quantum - np.rint(shown / quantum)).max() < 1e-6
    middle = (speed[:-1] + speed[1:]) / 2
    assert np.abs(shown[1:] - middle).max() < 1.1 * quantum
    lags = [np.sum((np.interp(np.arange(speed.size) - late, np.arange(speed.size), speed) - shown) ** 2)
            for late in np.linspace(0.0, 1.0, 21)]  # fmt: skip
    assert np.linspace(0.0, 1.0, 21)[int(np.argmin(lags))] == pytest.approx(0.5, abs=0.1)


def test_a_filtered_speed_object_lags_by_its_time_constant() -> None:
    machine = axis(speed_object_filter_s=5e-3)
    told, true = [], []
    for points in points_of(there_and_back()[:200]):
        machine.cycle(True, command(points))
        told.append(machine.seen.speed_rad_s)
        true.append(machine.speed_rad_s)
    rate = np.gradient(true, 1e-3)
    late_s = (np.array(true) - told)[50:100] @ rate[50:100] / (rate[50:100] @ rate[50:100])
    assert late_s == pytest.approx(5e-3, abs=0.5e-3)


def test_loops_of_the_drive_may_differ_from_the_configured_ones() -> None:
    faster = axis(position_gain_per_s=100.0, speed_feedforward=0.0)
    slower = axis(speed_feedforward=0.0)
    lag = [RAMP[-1] - cut(machine, RAMP)[-1, 1] for machine in (faster, slower)]
    assert lag == pytest.approx([1.0, 2.0], rel=0.02)  # v / Kv


def test_speed_feedback_from_a_coarse_encoder_stirs_the_current() -> None:
    quiet, stirred = (cut(axis(encoder_bits=14, speed_feedback=how), RAMP) for how in ("shaft", "difference"))
    assert np.std(stirred[300:, 3]) > 2 * np.std(quiet[300:, 3])
    assert abs(stirred[-1, 1] - quiet[-1, 1]) < 0.02


def test_a_setpoint_filter_delays_the_axis() -> None:
    regulators = AXIS.regulators.model_copy(update={"setpoint_filter_s": 0.01, "setpoint_filter_order": 2})
    machine = RealPhysics(PLANT, regulators, 1e-3, INC, Reality(), rad_per_mm=RAD_PER_MM)
    assert RAMP[-1] - cut(machine, RAMP)[-1, 1] == pytest.approx(100.0 * 0.02, rel=0.02)  # two times 10 ms


def test_the_kernel_says_the_same_in_plain_python(monkeypatch: pytest.MonkeyPatch) -> None:
    keys: dict[str, Any] = {"static_friction": 0.2, "presliding_um": 5.0, "friction_ripple": 0.05, "load_nm": 1.0,
            "screw_ripple_nm": 0.2, "motor_ripple_nm": 0.2, "resonance_hz": 90.0, "table_friction": 0.5,
            "pitch_error_um": 2.0, "dead_time_v": 1.0, "bus_sag": 0.03, "encoder_bits": 20,
            "speed_feedback": "difference", "setpoint_filter_s": 1e-3, "current_delay_cycles": 2}  # fmt: skip
    compiled, plain = axis(backlash_um=5.0, **keys), axis(backlash_um=5.0, **keys)
    rows = cut(compiled, there_and_back()[:40])
    for name, kernel in vars(real_cycle).items():
        if hasattr(kernel, "py_func"):
            monkeypatch.setattr(real_cycle, name, kernel.py_func)
    np.testing.assert_allclose(cut(plain, there_and_back()[:40]), rows, rtol=1e-7, atol=1e-7)
    for machine in (compiled, plain):
        machine.cycle(False, REST)


@pytest.mark.parametrize("presliding_um", [0.0, 0.5, 10.0])
@pytest.mark.parametrize("static_friction", [-0.5, 0.5])
@pytest.mark.parametrize("resonance_hz", [0.0, 40.0, 400.0])
def test_it_follows_whatever_is_combined(presliding_um: float, static_friction: float, resonance_hz: float) -> None:
    machine = axis(
        backlash_um=10.0 if resonance_hz else 0.0,
        presliding_um=presliding_um,
        static_friction=static_friction,
        resonance_hz=resonance_hz,
        table_friction=0.5,
        position_encoder="motor",
    )
    rows = cut(machine, there_and_back())
    assert np.all(np.isfinite(rows))
    assert np.abs(rows[:, 0] - there_and_back()).max() < 0.3
    assert np.abs(rows[-1, 2]) < 1.0
