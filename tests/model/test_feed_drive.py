"""The open-loop model against an independent integration, and its exactness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from fdhil.model.feed_drive import build_system_matrix, compute_voltage_ramps, discretise_plant, simulate_plant
from fdhil.records import Float, Parameters, VoltageSampling
from tests.identification.bench_recordings import simulate_bench_shuttle

BENCH = Parameters(R=0.5, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0)


def test_step_is_the_matrix_exponential() -> None:
    for stiffness in (1.0, 1e3):
        p = Parameters(R=0.5 * stiffness, L=0.005, K=0.8, Jt=0.075, ft=0.05, Cd=5.0)
        step = discretise_plant(p, 1e-3)
        np.testing.assert_allclose(step.phi, expm(build_system_matrix(p) * 1e-3), rtol=1e-10, atol=1e-14)


def test_ramp_and_mean_responses_match_integration() -> None:
    a, h = build_system_matrix(BENCH), 1e-3
    step = discretise_plant(BENCH, h)
    mean, rise = 3.0, 2.0

    def compute_derivative(t: float, x: Float) -> Float:
        change: Float = a @ x + np.array([mean + rise * (t / h - 0.5), 0.0])
        return change

    exact = solve_ivp(compute_derivative, (0, h), [1.0, 2.0], rtol=1e-12, atol=1e-14).y[:, -1]
    stepped = step.phi @ [1.0, 2.0] + step.mean[:, 0] * mean + step.ramp[:, 0] * rise
    np.testing.assert_allclose(stepped, exact, rtol=1e-10)


def test_simulation_follows_the_bench_from_interval_means() -> None:
    bench = simulate_bench_shuttle()
    current, speed = simulate_plant(BENCH, bench.voltage, bench.dt_s, "interval_mean")
    assert np.abs(speed - bench.speed).max() < 2e-4 * np.abs(bench.speed).max()
    assert np.abs(current - bench.current).max() < 2e-3 * np.abs(bench.current).max()


def test_simulation_continues_from_given_state() -> None:
    bench = simulate_bench_shuttle()
    k = 400
    start = (float(bench.current[k]), float(bench.speed[k]))
    _, speed = simulate_plant(BENCH, bench.voltage[k:700], bench.dt_s, "interval_mean", *start)
    np.testing.assert_allclose(speed, bench.speed[k:700], rtol=1e-4)


def test_drive_sticks_until_torque_exceeds_dry_friction() -> None:
    holding = np.full(400, 0.9 * 5.0 / 0.8 * 0.5)
    _, speed = simulate_plant(BENCH, holding, 1e-3, "instant")
    assert (speed == 0.0).all()
    _, speed = simulate_plant(BENCH, holding * 1.3, 1e-3, "instant")
    assert speed[-1] > 0.0


def test_motion_stops_and_stays_at_rest() -> None:
    _, speed = simulate_plant(BENCH, np.zeros(3000), 1e-3, "interval_mean", 0.0, 10.0)
    assert speed[0] == 10.0
    assert (speed[2000:] == 0.0).all()
    assert (speed >= 0.0).all()


@pytest.mark.parametrize("sampling", ["interval_mean", "instant"])
def test_reversed_voltage_reverses_all_signals(sampling: VoltageSampling) -> None:
    bench = simulate_bench_shuttle()
    voltage = bench.voltage if sampling == "interval_mean" else bench.voltage_instant
    there = simulate_plant(BENCH, voltage, bench.dt_s, sampling)
    back = simulate_plant(BENCH, -voltage, bench.dt_s, sampling)
    np.testing.assert_allclose(back[1], -there[1], atol=1e-12)


def test_voltage_ramps_keep_interval_means() -> None:
    mean, rise = compute_voltage_ramps(np.array([0.0, 1.0, 3.0]), "interval_mean")
    np.testing.assert_allclose(mean, [0.0, 1.0, 3.0])
    np.testing.assert_allclose(rise, [1.0, 1.5, 2.0])
    mean, rise = compute_voltage_ramps(np.array([0.0, 1.0, 3.0]), "instant")
    np.testing.assert_allclose(mean, [0.5, 2.0, 3.0])
    np.testing.assert_allclose(rise, [1.0, 2.0, 0.0])
