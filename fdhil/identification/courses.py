"""Adds fitted terms to a window's load and voltage: theta is [R, L, K, Jt, ft, Cd, delay, terms]."""

import numpy as np

from fdhil.identification.kalman import CD, DELAY, LOAD, VOLTAGE
from fdhil.identification.motion import Motion
from fdhil.records import Float

FIRST_COURSE = DELAY + 1  # entry of theta of the first term


def any_voltage(motion: Motion) -> bool:
    """Return whether a term is a voltage."""
    return any(course.kind == VOLTAGE for course in motion.courses)


def load_nm(motion: Motion, theta: Float) -> Float:
    """Return dry friction and the torque of the terms (n,) against the positive direction over each interval."""
    return np.asarray(loads_nm(motion, theta[None])[0])


def loads_nm(motion: Motion, thetas: Float) -> Float:
    """Return the same (q, n) for each row of ``thetas`` (q, k)."""
    return _known(_added(thetas[:, CD, None] * motion.mode, motion, thetas, LOAD), motion, LOAD)


def terms_nm(motion: Motion, theta: Float) -> Float:
    """Return the torque of the terms (n,) without friction."""
    return np.asarray(_added(np.zeros((1, motion.n)), motion, theta[None], LOAD)[0])


def voltage_v(motion: Motion, theta: Float) -> Float:
    """Return the mean voltage (n,) at the motor over each interval, corrected for its delay."""
    (added,) = _added(motion.delayed(float(theta[DELAY]))[None], motion, theta[None], VOLTAGE)
    return _known(np.asarray(added), motion, VOLTAGE)


def voltage_terms_v(motion: Motion, theta: Float) -> Float:
    """Return the voltage (n,) that the terms add over each interval."""
    return np.asarray(_added(np.zeros((1, motion.n)), motion, theta[None], VOLTAGE)[0])


def _added(values: Float, motion: Motion, thetas: Float, kind: int) -> Float:
    amplitudes = thetas[:, FIRST_COURSE:].T[:, :, None]
    for course, amplitude in zip(motion.courses, amplitudes, strict=False):
        if course.kind == kind:
            values = values + amplitude * course.values
    return values


def _known(values: Float, motion: Motion, kind: int) -> Float:
    for course in motion.known:
        if course.kind == kind:
            values = values + course.values
    return values
