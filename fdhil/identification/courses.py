"""Adds the terms that joined the six to a window's load and voltage: theta is [R, L, K, Jt, ft, Cd, delay, terms]."""

from __future__ import annotations

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
    return _known(_added(theta[CD] * motion.mode, motion, theta, LOAD), motion, LOAD)


def terms_nm(motion: Motion, theta: Float) -> Float:
    """Return the torque of the terms (n,) alone."""
    return _added(np.zeros(motion.n), motion, theta, LOAD)


def voltage_v(motion: Motion, theta: Float) -> Float:
    """Return the mean voltage (n,) that reaches the motor over each interval, without its delay."""
    return _known(_added(motion.delayed(float(theta[DELAY])), motion, theta, VOLTAGE), motion, VOLTAGE)


def voltage_terms_v(motion: Motion, theta: Float) -> Float:
    """Return what the terms add to the voltage (n,) over each interval."""
    return _added(np.zeros(motion.n), motion, theta, VOLTAGE)


def _added(values: Float, motion: Motion, theta: Float, kind: int) -> Float:
    for course, amplitude in zip(motion.courses, theta[FIRST_COURSE:], strict=False):
        if course.kind == kind:
            values = values + amplitude * course.values
    return values


def _known(values: Float, motion: Motion, kind: int) -> Float:
    for course in motion.known:
        if course.kind == kind:
            values = values + course.values
    return values
