"""The Kalman filters: equal to a textbook's, reproducible from stored gains, and linear in the signals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fdhil.identification import kalman
from fdhil.identification.innovations import answers, gains_of, innovations, whiten
from fdhil.identification.motion import BROKEN_MODE, DIFFUSE, UNKNOWN_MODE, Motion, prepare
from fdhil.records import Float, VoltageSampling
from studies import bench
from tests.identification.recorded import windows

THETA = np.array([*bench.Plant().truth().values(), 0.0])


def _motion(sampling: VoltageSampling) -> Motion:
    """Return a rapid with three lost samples and an interval of unknown friction."""
    motion = prepare(replace(windows(0.002)[0], voltage_sampling=sampling))
    motion.mode[500] = BROKEN_MODE
    motion.observed[500:503] = False
    return motion


def _textbook(motion: Motion, theta: Float) -> Float:
    """Return the whitened innovations (2 n,) by matrices, with the same transition coefficients."""
    means = motion.voltage_sampling == "interval_mean"
    voltage, current, speed = motion.noise.vector() ** 2
    steps = kalman.interval_steps(theta, motion.dt_s, 1.0 if means else 0.0)
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
def test_the_written_out_filter_is_the_textbooks(sampling: VoltageSampling) -> None:
    motion = _motion(sampling)
    white, _ = whiten(motion, THETA[None], motion.noise.vector()[None] ** 2)
    expected = _textbook(motion, THETA)
    np.testing.assert_allclose(white[:, 0], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("sampling", ["interval_mean", "instant"])
def test_kept_gains_give_the_innovations_that_they_were_made_with(sampling: VoltageSampling) -> None:
    motion = _motion(sampling)
    white, logdet = whiten(motion, THETA[None], motion.noise.vector()[None] ** 2)
    gains = gains_of(motion, THETA, motion.noise)
    np.testing.assert_allclose(innovations(motion, THETA, gains), white[:, 0], rtol=1e-9, atol=1e-9)
    assert gains.logdet == logdet[0]


@pytest.mark.parametrize("name", ["current", "speed"])
def test_an_answer_is_the_change_of_the_innovations(name: str) -> None:
    motion = _motion("interval_mean")
    gains = gains_of(motion, THETA, motion.noise)
    course = np.sin(np.arange(motion.n) / 50.0)
    changed = replace(motion, **{name: getattr(motion, name) + course})
    kind = kalman.CURRENT if name == "current" else kalman.SPEED
    answer = answers(motion, THETA, gains, kind, course[None])[:, 0]
    np.testing.assert_allclose(
        answer, innovations(changed, THETA, gains) - innovations(motion, THETA, gains), atol=1e-6
    )


def test_a_load_is_answered_as_one_that_is_there() -> None:
    motion = _motion("interval_mean")
    gains = gains_of(motion, THETA, motion.noise)
    load = np.linspace(0.0, 1.0, motion.n)
    there = innovations(motion, THETA, gains, load) - innovations(motion, THETA, gains)
    np.testing.assert_allclose(answers(motion, THETA, gains, kalman.LOAD, load[None])[:, 0], there, atol=1e-6)
