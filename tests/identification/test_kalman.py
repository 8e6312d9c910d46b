"""The Kalman filters: equal to a textbook's, reproducible from stored gains, and linear in the signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification import kalman
from fdhil.identification.innovations import (
    compute_filter_gains,
    compute_innovations,
    compute_signal_response,
    whiten_innovations,
)
from fdhil.identification.prepared_motion import BROKEN_MODE, DIFFUSE, UNKNOWN_MODE, Motion, prepare_window
from fdhil.records import Float, VoltageSampling
from studies import bench
from tests.identification.bench_recordings import find_noisy_windows

THETA = np.array([*bench.Plant().truth().values(), 0.0])


def _build_motion(sampling: VoltageSampling) -> Motion:
    """Return a rapid with three lost samples and an interval of unknown friction."""
    motion = prepare_window(replace(find_noisy_windows(0.002)[0], voltage_sampling=sampling))
    motion.mode[500] = BROKEN_MODE
    motion.observed[500:503] = False
    return motion


def _whiten_by_matrices(motion: Motion, theta: Float) -> Float:
    """Return the whitened innovations (2 n,) by matrices, with the same transition coefficients."""
    means = motion.voltage_sampling == "interval_mean"
    voltage, current, speed = motion.noise.to_array() ** 2
    steps = kalman.compute_interval_steps(theta, motion.dt_s, 1.0 if means else 0.0)
    measured = np.diag([current, speed])
    x, p = np.array([motion.current[0], motion.speed[0]]), DIFFUSE * measured
    white = np.zeros((motion.n, 2))
    for k, mode in enumerate(motion.mode):
        if motion.observed[k]:
            spread = p + measured
            error = np.array([motion.current[k], motion.speed[k]]) - x
            white[k] = np.linalg.solve(np.linalg.cholesky(spread), error)
            gain = p @ np.linalg.inv(spread)
            x, p = x + gain @ error, (np.eye(2) - gain) @ p
        if mode == BROKEN_MODE:
            p = DIFFUSE * measured
            continue
        s = steps[0 if mode == UNKNOWN_MODE else 1]
        phi, of_voltage = s[:4].reshape(2, 2), s[[kalman.I_U, kalman.W_U]]
        walk = np.array([s[kalman.I_WALK], 1.0]) * (motion.speed_walk if mode == UNKNOWN_MODE else 0.0)
        rise = 0.0 if means else motion.voltage_rise[k]
        x = phi @ x + of_voltage * motion.voltage_mean[k] + s[[kalman.I_RISE, kalman.W_RISE]] * rise
        x = x + s[[kalman.I_T, kalman.W_T]] * theta[kalman.CD] * mode
        p = phi @ p @ phi.T + voltage * np.outer(of_voltage, of_voltage) + np.outer(walk, walk)
    return white.ravel()


@pytest.mark.parametrize("sampling", ["interval_mean", "instant"])
def test_filter_matches_the_matrix_kalman_filter(sampling: VoltageSampling) -> None:
    motion = _build_motion(sampling)
    white, _ = whiten_innovations(motion, THETA[None], motion.noise.to_array()[None] ** 2)
    expected = _whiten_by_matrices(motion, THETA)
    np.testing.assert_allclose(white[:, 0], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("sampling", ["interval_mean", "instant"])
def test_stored_gains_reproduce_the_innovations(sampling: VoltageSampling) -> None:
    motion = _build_motion(sampling)
    white, logdet = whiten_innovations(motion, THETA[None], motion.noise.to_array()[None] ** 2)
    gains = compute_filter_gains(motion, THETA, motion.noise)
    np.testing.assert_allclose(compute_innovations(motion, THETA, gains), white[:, 0], rtol=1e-9, atol=1e-9)
    assert gains.logdet == logdet[0]


@pytest.mark.parametrize("name", ["current", "speed"])
def test_signal_response_equals_the_change_of_innovations(name: str) -> None:
    motion = _build_motion("interval_mean")
    gains = compute_filter_gains(motion, THETA, motion.noise)
    course = np.sin(np.arange(motion.n) / 50.0)
    changed = replace(motion, **{name: getattr(motion, name) + course})
    kind = kalman.CURRENT if name == "current" else kalman.SPEED
    answer = compute_signal_response(motion, THETA, gains, kind, course[None])[:, 0]
    np.testing.assert_allclose(
        answer, compute_innovations(changed, THETA, gains) - compute_innovations(motion, THETA, gains), atol=1e-6
    )


def test_load_response_equals_an_actual_load() -> None:
    motion = _build_motion("interval_mean")
    gains = compute_filter_gains(motion, THETA, motion.noise)
    load = np.linspace(0.0, 1.0, motion.n)
    there = compute_innovations(motion, THETA, gains, load) - compute_innovations(motion, THETA, gains)
    np.testing.assert_allclose(
        compute_signal_response(motion, THETA, gains, kalman.LOAD, load[None])[:, 0], there, atol=1e-6
    )
