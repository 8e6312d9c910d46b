"""Adds fitted terms to a window's load and voltage: theta is [R, L, K, Jt, ft, Cd, delay, terms]."""

import numpy as np

from fdhil.identification.kalman import CD, DELAY, LOAD, VOLTAGE
from fdhil.identification.prepared_motion import Motion
from fdhil.records import Float

FIRST_TERM = DELAY + 1  # entry of theta of the first term


def has_voltage_term(motion: Motion) -> bool:
    """Return whether a term is a voltage."""
    return any(course.kind == VOLTAGE for course in motion.courses)


def compute_load_nm(motion: Motion, theta: Float) -> Float:
    """Return dry friction and the torque of the terms (n,) against the positive direction over each interval."""
    return np.asarray(compute_loads_nm(motion, theta[None])[0])


def compute_loads_nm(motion: Motion, thetas: Float) -> Float:
    """Return the same (q, n) for each row of ``thetas`` (q, k)."""
    return _add_known_terms(_add_fitted_terms(thetas[:, CD, None] * motion.mode, motion, thetas, LOAD), motion, LOAD)


def compute_term_torque_nm(motion: Motion, theta: Float) -> Float:
    """Return the torque of the terms (n,) without friction."""
    return np.asarray(_add_fitted_terms(np.zeros((1, motion.n)), motion, theta[None], LOAD)[0])


def compute_motor_voltage_v(motion: Motion, theta: Float) -> Float:
    """Return the mean voltage (n,) at the motor over each interval, corrected for its delay."""
    (added,) = _add_fitted_terms(
        motion.compute_delayed_voltage(float(theta[DELAY]))[None], motion, theta[None], VOLTAGE
    )
    return _add_known_terms(np.asarray(added), motion, VOLTAGE)


def compute_term_voltage_v(motion: Motion, theta: Float) -> Float:
    """Return the voltage (n,) that the terms add over each interval."""
    return np.asarray(_add_fitted_terms(np.zeros((1, motion.n)), motion, theta[None], VOLTAGE)[0])


def _add_fitted_terms(values: Float, motion: Motion, thetas: Float, kind: int) -> Float:
    amplitudes = thetas[:, FIRST_TERM:].T[:, :, None]
    for course, amplitude in zip(motion.courses, amplitudes, strict=False):
        if course.kind == kind:
            values = values + amplitude * course.values
    return values


def _add_known_terms(values: Float, motion: Motion, kind: int) -> Float:
    for course in motion.known:
        if course.kind == kind:
            values = values + course.values
    return values
