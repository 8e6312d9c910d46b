"""Whitens the part of a window's current and speed that the model, driven by the measured voltage, does not explain.

Each filter belongs to its parameters and noise levels. Its response is linear in the signals, so score tests use one
filter for many changes of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fdhil.identification import kalman
from fdhil.identification.kalman import CD, CURRENT, DELAY, LOAD, SPEED, VOLTAGE, Readings
from fdhil.identification.low_rate_voltage.low_rate_innovations import compute_low_rate_innovations
from fdhil.identification.prepared_motion import Motion, NoiseLevels
from fdhil.identification.term_regressors import (
    FIRST_TERM,
    compute_load_nm,
    compute_loads_nm,
    compute_motor_voltage_v,
    has_voltage_term,
)
from fdhil.records import Float

__all__ = [
    "CURRENT",
    "LOAD",
    "SPEED",
    "VOLTAGE",
    "FilterGains",
    "compute_filter_gains",
    "compute_innovations",
    "compute_signal_response",
    "compute_waveform_response",
    "whiten_innovations",
]
NOTHING: Float = np.zeros((0, 0))


@dataclass(frozen=True, slots=True)
class FilterGains:
    """The filter's gains (n, 7) by sample and log determinant, for fixed parameters and noise.

    With a low-rate voltage the filter is rebuilt from the noise's ``variances`` (3,), and there are no gains.
    """

    gains: Float
    logdet: float
    variances: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def whitening_factors(self) -> Float:
        """The factors (n, 3) that whiten a sample: current to current, current to speed, speed to speed."""
        return self.gains[:, kalman.WHITE_I :]


def compute_filter_gains(motion: Motion, theta: Float, noise: NoiseLevels) -> FilterGains:
    """Return the filter's gains for ``theta`` (k,) = [R, L, K, Jt, ft, Cd, delay, terms]."""
    variances = noise.to_array() ** 2
    if motion.slow is not None:
        return FilterGains(NOTHING, compute_low_rate_innovations(motion, theta, variances).logdet, variances)
    gains = np.zeros((motion.n, 7))
    return FilterGains(gains, float(_run_whitening_filter(motion, theta[None], variances[None], gains)[1][0]))


def whiten_innovations(motion: Motion, thetas: Float, variances: Float) -> tuple[Float, Float]:
    """Return the whitened innovations (m, q) for the rows of ``thetas`` (q, k), each by its own filter.

    Current and speed alternate sample by sample, the samples of a low-rate voltage (m,) follow. With the right model
    all are white with unit variance. ``variances`` (q, 3) are those of voltage, current and speed; the log determinants
    (q,) are returned too.
    """
    if motion.slow is None:
        white, logdet = _run_whitening_filter(motion, thetas, variances, NOTHING)
        return white.reshape(len(thetas), -1).T, logdet
    pairs = zip(thetas, variances, strict=True)
    made = [compute_low_rate_innovations(motion, theta, v) for theta, v in pairs]
    return np.column_stack([one.whitened for one in made]), np.array([one.logdet for one in made])


def _run_whitening_filter(motion: Motion, thetas: Float, variances: Float, gains: Float) -> tuple[Float, Float]:
    delays = thetas[:, DELAY:] if has_voltage_term(motion) else thetas[:, DELAY, None]
    together = bool((delays == delays[0]).all())
    voltages = np.array([compute_motor_voltage_v(motion, theta) for theta in (thetas[:1] if together else thetas)])
    frictions = thetas[:, [CD, *range(FIRST_TERM, thetas.shape[1])]]
    loads = compute_loads_nm(motion, thetas[:1] if bool((frictions == frictions[0]).all()) else thetas)
    return kalman.whiten_for_parameters(thetas, variances, Readings.from_motion(motion), voltages, loads, gains)


def compute_innovations(
    motion: Motion, theta: Float, gains: FilterGains, more_nm: Float | None = None, emf_share: float = 1.0
) -> Float:
    """Return the whitened innovations (m,) by a filter made earlier, in the same order as when it was made.

    ``more_nm`` (n,) is an additional torque against the positive direction over each interval; ``emf_share`` is the
    share of the back-EMF's ramp within a voltage sample that is used.
    """
    if motion.slow is not None:
        return compute_low_rate_innovations(motion, theta, gains.variances, more_nm=more_nm).whitened
    load = compute_load_nm(motion, theta)
    readings = Readings.from_motion(motion, emf_share)
    signals = np.stack([load, compute_motor_voltage_v(motion, theta), motion.current, motion.speed])
    loads = (load if more_nm is None else load + more_nm)[None]
    white = kalman.compute_filter_response(theta, readings, signals, LOAD, loads, readings.rise_v[None], gains.gains)
    return white.ravel()


def compute_signal_response(
    motion: Motion,
    theta: Float,
    gains: FilterGains,
    kind: int,
    courses: Float | Sequence[Float],
    rises: Float | Sequence[Float] | None = None,
) -> Float:
    """Return the change (2 n, q) of the innovations when a signal changes by each of ``courses`` (q, n).

    ``kind`` names the signal: ``LOAD`` (N.m against the positive direction), ``VOLTAGE`` (V, over each interval with
    ``rises`` within them), ``CURRENT`` (A) or ``SPEED`` (rad/s). The voltage must be sampled with the other signals.
    """
    readings = Readings.from_motion(motion)
    within = NOTHING if rises is None or not readings.rise_v.size else np.asarray(rises)
    signals = np.zeros((4, motion.n))
    white = kalman.compute_filter_response(theta, readings, signals, kind, np.asarray(courses), within, gains.gains)
    return white.reshape(-1, len(courses))


def compute_waveform_response(motion: Motion, theta: Float, gains: FilterGains) -> Float:
    """Return the change (2 n, q) of the innovations with the unknown voltage and current within samples."""
    assert motion.within is not None
    rises, currents = motion.within.rise_v, motion.within.current_a
    readings, signals = Readings.from_motion(motion), np.zeros((4, motion.n))
    white = kalman.compute_filter_response(theta, readings, signals, VOLTAGE, np.zeros_like(rises), rises, gains.gains)
    return white.reshape(-1, len(rises)) + compute_signal_response(motion, theta, gains, CURRENT, currents)
