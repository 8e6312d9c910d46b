"""Computes innovations of a window whose voltage sensor is slower than the drive: one for each voltage sample.

The voltage is never resampled to the drive's grid. A Kalman filter runs over the drive's samples: [2] drives the speed
from the current, the current's slope is a random walk, and each voltage sample is a measurement of [1] over its
interval, or at its instant:

    mean u = (R int i dt + L (i(end) - i(start)) + K int w dt) / T,        u = R i + L di/dt + K w.

The state is [i, w, di/dt, (R int i dt + K int w dt - L i(start)) / T], the integrals from the running sample's start.
Current and speed are processed one after the other, so every innovation is scalar with its own variance. A delay of the
voltage moves the ends of its samples among the drive's: it is a parameter like the others.
"""

from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification.filtering import compute_moving_mean
from fdhil.identification.kalman import DELAY, JT, NO_SAMPLE, K, Readings, SampleMarks, SlowSensor, run_low_rate_filter
from fdhil.identification.prepared_motion import Motion
from fdhil.identification.term_regressors import compute_term_torque_nm
from fdhil.records import Float, make_read_only_view

CURRENT_LATE_S, CURRENT_LATE = 1e-5, 0.01  # in s, and of a sample: one standard deviation, see below
CURRENT_ABOVE = 2.5e-4  # of the accelerating current, one standard deviation
CORNER_ROWS = 5
SMOOTH_ROWS = 15


@dataclass(frozen=True, slots=True)
class LowRateInnovations:
    """Innovations (2 n + m,) of current and speed sample by sample, then of the voltage, and their ``variance``.

    Missing measurements have innovation 0 and variance 1.
    """

    values: Float
    variance: Float

    @property
    def whitened(self) -> Float:
        """The innovations, each in its own standard deviations."""
        return self.values / np.sqrt(self.variance)

    @property
    def logdet(self) -> float:
        """Logarithm of the determinant of their covariance."""
        return float(np.log(self.variance).sum())

    @property
    def cost(self) -> float:
        """Minus twice their log likelihood, without its constant; infinite where it is not finite."""
        value = float(self.whitened @ self.whitened) + self.logdet
        return value if np.isfinite(value) else np.inf


def locate_voltage_samples(motion: Motion, delay_s: float, ordered_for_s: float) -> SampleMarks:
    """Return the marks of a voltage that is late by ``measure_delay_s``, in the order of a delay of ``ordered_for_s``.

    While a delay is varied slightly, an innovation must stay that of the same sample: a mark that passed a sample would
    change the meaning of both.
    """
    slow, n = motion.slow, motion.n
    assert slow is not None
    m, last = slow.voltage_v.size, (n - 1) * motion.dt_s
    grid = slow.begin_s + slow.period_s * np.arange(m + 1)
    if slow.late_s is not None:
        grid[:m] += slow.late_s
    placed = grid - ordered_for_s
    inside = np.flatnonzero((placed >= 0.0) & (placed <= last))
    if motion.voltage_sampling == "instant":
        inside = inside[inside < m]
        sample = np.where(np.isfinite(slow.voltage_v[inside]), inside, NO_SAMPLE)
    else:
        ends = inside - 1
        known = (ends >= 0) & (inside > inside.min(initial=m)) & np.isfinite(slow.voltage_v[np.maximum(ends, 0)])
        sample = np.where(known, ends, NO_SAMPLE)
    row = np.minimum(np.floor(placed[inside] / motion.dt_s), n - 1)
    return SampleMarks(row.astype(np.int64), sample.astype(np.int64), np.asarray(grid[inside] - delay_s, np.float64))


def compute_shift_room_s(motion: Motion, delay_s: float) -> tuple[float, float]:
    """Return by how much all voltage samples may move earlier, and later, before one passes a drive's sample."""
    marks = locate_voltage_samples(motion, delay_s, delay_s)
    after = marks.time_s - marks.row * motion.dt_s
    return float(after.min(initial=motion.dt_s)), float((motion.dt_s - after).min(initial=motion.dt_s))


def list_reading_variances(motion: Motion, variances: Float) -> Float:
    """Return the variances (n, 2) of each sample's current and speed, infinite where lost."""
    return np.where(motion.observed[:, None], variances[1:], np.inf)


def compute_low_rate_innovations(
    motion: Motion,
    theta: Float,
    variances: Float,
    ordered_for_s: float | None = None,
    more_nm: Float | None = None,
    spread: Float | None = None,
) -> LowRateInnovations:
    """Return the innovations by the filter matched to ``theta`` (7,) = [R, L, K, Jt, ft, Cd, delay].

    ``variances`` (3,) are those of voltage, current and speed; ``ordered_for_s`` is the delay that orders the samples
    (default: the own); ``more_nm`` (n,) is an additional torque against the positive direction; ``spread`` (n, 2)
    replaces the variances of current and speed.
    """
    assert motion.slow is not None
    delay_s = float(theta[DELAY])
    marks = locate_voltage_samples(motion, delay_s, delay_s if ordered_for_s is None else ordered_for_s)
    instant = motion.voltage_sampling == "instant"
    voltage = make_read_only_view(motion.voltage_mean)
    sensor = SlowSensor(voltage, instant, motion.slow.period_s, motion.shape_variance, marks)
    spread = list_reading_variances(motion, variances) if spread is None else spread
    more = np.zeros(0) if more_nm is None else more_nm
    load = compute_term_torque_nm(motion, theta) + (more if more.size else 0.0) if motion.courses else more
    readings = Readings.from_motion(motion)
    return LowRateInnovations(*run_low_rate_filter(theta, readings, sensor, variances, spread, load, motion.slope_walk))


def compute_waveform_effect(motion: Motion, theta: Float, variances: Float) -> Float:
    """Return the change (2 n + m,) of the whitened innovations with the unknown current between samples.

    Regulators act in steps, and samples are taken at the end of a step: a changing current is then behind its mean, by
    1.3 % of a sample with steps of a quarter of it and a current loop of 400 Hz (half a sample: 5 %, an eighth: 0.3 %).
    Linearly interpolated set-points leave an accelerating current above its mean where they meet.
    """
    slope = np.gradient(compute_moving_mean(motion.current, CORNER_ROWS))
    accelerating = theta[JT] / theta[K] * np.gradient(compute_moving_mean(motion.speed, SMOOTH_ROWS), motion.dt_s)
    late_rows = max(CURRENT_LATE, CURRENT_LATE_S / motion.dt_s)  # shorter samples do not make regulators faster
    mean = replace(motion, current=motion.current + late_rows * slope - CURRENT_ABOVE * accelerating)
    changed: Float = compute_low_rate_innovations(mean, theta, variances).whitened
    return changed - compute_low_rate_innovations(motion, theta, variances).whitened


def estimate_open_voltage_v(motion: Motion, theta: Float, variances: Float) -> float:
    """Return the median standard deviation (V) of a voltage sample predicted from current and speed."""
    made = compute_low_rate_innovations(motion, theta, variances)
    known = made.values[2 * motion.n :] != 0.0
    if not known.any():
        return 0.0
    beyond = made.variance[2 * motion.n :][known] - variances[0]
    return float(np.sqrt(max(np.median(beyond), 0.0)))


def sum_by_sample(motion: Motion, delay_s: float, columns: Float) -> Float:
    """Return sums (n, k) by sample of values of innovations (2 n + m, k): a voltage sample counts where it ends."""
    n = motion.n
    by_row: Float = columns[: 2 * n].reshape(n, 2, -1).sum(axis=1)
    if motion.slow is None:
        return by_row
    marks = locate_voltage_samples(motion, delay_s, delay_s)
    known = marks.sample != NO_SAMPLE
    np.add.at(by_row, marks.row[known], columns[2 * n + marks.sample[known]])
    return by_row
