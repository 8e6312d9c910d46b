"""The plant and the loops against an independent integration of the same equations by scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fdhil.records import Float, Parameters
from fdhil.sim.drive import plant_physics
from fdhil.sim.drive.plant_physics import Command, PlantPhysics, discretise_plant
from tests.bench import bench_config

AXIS = bench_config("X").axis["X"]
PLANT = Parameters(0.5, 0.005, 0.8, 0.075, 0.05, 5.0)
INC = 65536
H = 3.125e-5


def create_plant_derivative(p: Parameters, u: float, load: float, direction: float) -> Any:
    def compute_derivative(_t: float, y: Float) -> Float:
        i, w, _ = y
        torque = p.K * i - load
        stuck = direction == 0.0
        return np.array(
            [(u - p.R * i - p.K * w) / p.L, 0.0 if stuck else (torque - p.ft * w - p.Cd * direction) / p.Jt, w]
        )

    return compute_derivative


def integrate_step(p: Parameters, state: Float, u: float, load: float) -> Float:
    """One 31.25 us step by an adaptive Runge-Kutta method, with the bench's rules for stiction and reversal."""
    i, w, _ = state
    drive = p.K * i - load
    direction = np.sign(w) if w else (0.0 if abs(drive) <= p.Cd else np.sign(drive))
    solution = solve_ivp(create_plant_derivative(p, u, load, direction), (0, H), state, rtol=1e-9, atol=1e-12)
    end: Float = solution.y[:, -1]
    if direction * end[1] < 0:
        end[1] = 0.0
    return end


class ReferencePlant:
    """The three loops and the plant, implemented independently from the bench's description."""

    def __init__(self, p: Parameters) -> None:
        self.p = p
        self.r = AXIS.regulators
        self.state = np.zeros(3)
        self.speed_integral = self.current_integral = 0.0

    def run_cycle(self, points: tuple[float, float, float], load: float = 0.0) -> float:
        r, volts = self.r, []
        for m in range(4):
            x = round(self.state[2] * INC / (2 * np.pi))
            target = points[0] + (points[1] - points[0]) * m / 4
            slope = ((points[1] - points[0]) * (1 - m / 4) + (points[2] - points[1]) * m / 4) / 1e-3
            demand = (r.position_gain_per_s * (target - x) + r.speed_feedforward * slope) * 2 * np.pi / INC
            current_demand, self.speed_integral = self.run_pi(
                demand - self.state[1], self.speed_integral, r.speed_kp, r.speed_ki, 2.5e-4, r.current_limit_a
            )
            for _ in range(8):
                u, self.current_integral = self.run_pi(
                    current_demand - self.state[0],
                    self.current_integral,
                    r.current_kp,
                    r.current_ki,
                    H,
                    r.voltage_limit_v,
                )
                self.state = integrate_step(self.p, self.state, u, load)
                volts.append(u)
        return float(np.mean(volts))

    @staticmethod
    def run_pi(e: float, integral: float, kp: float, ki: float, h: float, limit: float) -> tuple[float, float]:
        candidate = integral + ki * h * e
        raw = kp * e + candidate
        output = float(np.clip(raw, -limit, limit))
        return output, candidate if output == raw else integral


def list_points(reference_mm: Float) -> list[tuple[float, float, float]]:
    r = np.rint(np.append(reference_mm, [reference_mm[-1]] * 2) * INC / 20.0)
    return [(r[k], r[k + 1], r[k + 2]) for k in range(reference_mm.size)]


def build_command(points: tuple[float, float, float]) -> Command:
    p0, p1, p2 = points
    return p0, p1, (p1 - p0) / 1e-3, (p2 - p1) / 1e-3, 0.0, 0.0, 0.0, 0.0


def build_rapid_mm(n: int = 70, acceleration: float = 4000.0) -> Float:
    """Return a short rapid back and forth: 30 ms of acceleration, then twice as much in the other direction."""
    t = np.arange(n) * 1e-3
    speed = np.where(t < 0.03, acceleration * t, acceleration * (0.03 - 2 * (t - 0.03)))
    return np.asarray(np.cumsum(speed) * 1e-3)


def test_step_is_matrix_exponential() -> None:
    p = PLANT
    a = np.zeros((5, 5))
    a[0] = [-p.R / p.L, -p.K / p.L, 0, 1 / p.L, 0]
    a[1] = [p.K / p.Jt, -p.ft / p.Jt, 0, 0, 1 / p.Jt]
    a[2, 1] = 1
    for step in (H, 1e-3, 0.05):
        got = discretise_plant(np.array([p.R, p.L, p.K, p.Jt, p.ft, p.Cd]), step)
        np.testing.assert_allclose(got, expm(a * step), rtol=1e-11, atol=1e-13)


def test_rapid_with_reversal_matches_independent_integration() -> None:
    twin, oracle = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC), ReferencePlant(PLANT)
    worst_um = worst_v = 0.0
    for points in list_points(build_rapid_mm()):
        mean = oracle.run_cycle(points)
        twin.run_cycle(True, build_command(points))
        worst_um = max(worst_um, abs(twin.angle_rad - oracle.state[2]) * 20e3 / (2 * np.pi))
        worst_v = max(worst_v, abs(twin.voltage_mean_v - mean))
    assert worst_um < 0.5
    assert worst_v < 0.5
    assert twin.speed_rad_s < -10.0  # it went there and is on its way back


def test_dry_friction_holds_below_and_slips_above_limit() -> None:
    twin = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC)
    idle = build_command((0.0, 0.0, 0.0))
    twin.load_torque_nm = 4.999
    for _ in range(50):
        twin.run_cycle(False, idle)
    assert twin.speed_rad_s == 0.0 == twin.angle_rad
    twin.load_torque_nm = 5.2
    for _ in range(50):
        twin.run_cycle(False, idle)
    # 0.2 N.m on 0.075 kg.m2 for 50 ms, against the Tl that drives it backward
    assert twin.speed_rad_s == pytest.approx(-0.2 / 0.075 * 0.05, rel=0.02)


def test_unpowered_plant_coasts_to_rest_and_shows_back_emf() -> None:
    twin = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC)
    for points in list_points(np.linspace(0.0, 20.0, 100)):
        twin.run_cycle(True, build_command(points))
    speed = twin.speed_rad_s
    twin.run_cycle(False, build_command((0.0, 0.0, 0.0)))
    assert twin.current_a == 0.0
    assert twin.voltage_mean_v == pytest.approx(PLANT.K * (speed + twin.speed_rad_s) / 2, rel=1e-3)
    expected = speed - (PLANT.Cd + PLANT.ft * speed) / PLANT.Jt * 1e-3
    assert twin.speed_rad_s == pytest.approx(expected, rel=1e-4)
    for _ in range(2000):
        twin.run_cycle(False, build_command((0.0, 0.0, 0.0)))
    assert twin.speed_rad_s == 0.0


def test_limits_act_and_are_reported() -> None:
    twin = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC)
    flags = set()
    for _ in range(200):
        twin.run_cycle(True, build_command((3e5, 3e5, 3e5)))  # a step of 90 mm
        flags |= {(twin.current_limited, twin.voltage_limited)}
        assert np.abs(twin.voltage_v).max() <= 300.0
        assert abs(twin.current_a) < 202.0
    assert any(current for current, _ in flags)
    assert any(voltage for _, voltage in flags)


def test_table_rests_in_backlash_while_motor_reverses() -> None:
    lost = 2 * np.pi * 0.05 / 20  # 50 um
    twin = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC, backlash_rad=lost)
    reference = np.concatenate(
        [np.linspace(0, 2, 200), np.full(200, 2.0), np.linspace(2, 1.99, 200), np.full(400, 1.99)]
    )
    for points in list_points(reference):
        twin.run_cycle(True, build_command(points))
        assert abs(twin.angle_rad - twin.table_rad) <= lost / 2 + 1e-12
    # the loop closes on the table: the motor has gone back by the lost motion
    assert twin.table_rad - twin.angle_rad == pytest.approx(lost / 2, abs=1e-9)


def test_speed_and_current_offsets_enter_loops() -> None:
    with_speed, with_current = (PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC) for _ in range(2))
    # 1 rad/s on the speed demand is, held for ever, 1/Kv of position
    for _ in range(600):
        with_speed.run_cycle(True, (0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0))
    assert with_speed.angle_rad == pytest.approx(1 / 50, abs=2e-4)
    with_current.run_cycle(True, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0, 5.0))
    assert with_current.current_a == pytest.approx(5.0, rel=0.15)  # 400 Hz of bandwidth, after 1 ms
    assert with_current.speed_rad_s == 0.0  # 4 N.m do not break the dry friction


def test_kernel_is_bit_identical_to_plain_python(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC, backlash_rad=1e-4)
    plain = PlantPhysics(PLANT, AXIS.regulators, 1e-3, INC, backlash_rad=1e-4)
    reference = list_points(build_rapid_mm(40))
    compiled_rows, plain_rows = [], []
    for points in reference:
        compiled.run_cycle(True, build_command(points))
        compiled_rows.append((compiled.angle_rad, compiled.current_a, compiled.voltage_mean_v))
    for kernel in (plant_physics.simulate_sync_cycle, plant_physics._step_plant, plant_physics._coast_plant):
        monkeypatch.setattr(plant_physics, kernel.py_func.__name__, kernel.py_func)
    for points in reference:
        plain.run_cycle(True, build_command(points))
        plain_rows.append((plain.angle_rad, plain.current_a, plain.voltage_mean_v))
    assert compiled_rows == plain_rows
