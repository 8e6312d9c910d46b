"""Instrumental variables: the paper's regression, its noisy regressors paired with simulated ones that have no noise.

Least squares is biased because the regressors i, Di, w and Dw carry sensor noise. Here each is paired with an
instrument that follows the same motion and knows nothing of the sensors: the speed that the NC's demand gives through
the drive's lag, and the current that [2] then needs. [2] is simulated with the estimate before, so the instruments are
refined with it (a simple refined instrumental-variable method; after Brunot, Janot, Young and Carrillo 2018).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.config import Identification
from fdhil.identification.derivatives import differentiate_signal
from fdhil.identification.estimators.least_squares import (
    OPEN_SHARE,
    PARAMETER_ORDER,
    AlignedSignals,
    align_signals,
    build_regressors,
    build_two_step_estimate,
    compute_residuals,
    propagate_sensor_noise,
    refuse_short_windows,
    solve_two_steps,
)
from fdhil.identification.filtering import filter_zero_phase
from fdhil.identification.identifiability import create_empty_estimate
from fdhil.identification.normal_equations import solve_least_squares
from fdhil.identification.rapid_windows import fill_forward
from fdhil.identification.robust_covariance import (
    compute_residual_autocovariances,
    compute_score_covariance,
    estimate_aliasing_doubt,
)
from fdhil.records import Estimate, Float, Reason, Result, Window

NAME = "instrumental_variables"
REFINEMENTS = 4
LEAST_ROWS = 8
# a demand in steps of a micrometre has rough derivatives; an instrument need only follow the motion, which is slower
SMOOTH_HZ = 60.0
LEAST_VOLTAGE_SHARE = 1e-3  # of the voltage's noise as its third differences show it


@dataclass(frozen=True, slots=True)
class Rows:
    """The usable rows of all windows: ``electrical`` (m, 4) [u, Di, i, w], ``mechanical`` (m, 4) [i, Dw, w, sign w].

    ``motion`` (m, 4) is [w, Dw, DDw, sign w] of the demand through the drive's lag; ``lengths`` are rows per window.
    """

    electrical: Float
    mechanical: Float
    motion: Float
    lengths: tuple[int, ...]

    @property
    def finite(self) -> bool:
        """Whether every number in the rows is finite."""
        return all(bool(np.isfinite(part).all()) for part in (self.electrical, self.mechanical, self.motion))

    def instruments(self, theta: Float) -> tuple[Float, Float]:
        """Return the instruments (m, 3) of [Di, i, w] and of [Dw, w, sign w] for ``theta`` = [L, R, K, Jt, ft, Cd]."""
        speed, rate, jerk, side = self.motion.T
        _, _, constant, inertia, viscous, dry = theta
        current = (inertia * rate + viscous * speed + dry * side) / constant
        slope = (inertia * jerk + viscous * rate) / constant
        return np.column_stack([slope, current, speed]), np.column_stack([rate, speed, side])


def estimate(windows: Sequence[Window], settings: Identification) -> Estimate:
    """Fit [5], then [6] with its K, to the windows together; they must have the demand that the drive followed."""
    usable = [w for w in windows if w.voltage_v is not None]
    rows = gather(usable, settings)
    if rows is None:
        return refuse_short_windows(NAME, 0)
    if not rows.finite:
        reason = Reason("NotFinite", "a filtered signal or the demand is not finite", "check the sensors")
        return create_empty_estimate(NAME, Result.NOT_FINITE, reason)
    theta = fit(rows)
    if not np.isfinite(theta).all():
        reason = Reason("LowExcitation", "the demand does not move as the drive does", "record the demand with it")
        return create_empty_estimate(NAME, Result.UNDER_EXCITED, reason)
    return _finish(rows, theta, usable, settings)


def raw_values(windows: Sequence[Window], settings: Identification) -> Float | None:
    """Return [R, L, K, Jt, ft, Cd] (6,) unchecked; None when there are too few rows."""
    rows = gather([w for w in windows if w.voltage_v is not None], settings)
    return None if rows is None else fit(rows)[PARAMETER_ORDER]


def gather(windows: Sequence[Window], settings: Identification) -> Rows | None:
    """Return the usable rows of the windows with what their instruments are made of; None when there are too few."""
    parts = []
    for window in windows:
        signals = align_signals(window, settings)
        motion = _demanded(window, signals, settings.lowpass_hz)
        di, dw = differentiate_signal(signals.current, window.dt_s), differentiate_signal(signals.speed, window.dt_s)
        electrical, mechanical = build_regressors(signals, window.dt_s)
        rows = signals.usable & np.isfinite(di) & np.isfinite(dw)
        # the demand's second derivative reaches further than the rows that least squares takes
        kept = np.isfinite(motion.sum(axis=1)[rows])
        parts.append((electrical[kept], mechanical[kept], motion[rows][kept]))
    parts = [part for part in parts if part[0].shape[0]]
    if sum(part[0].shape[0] for part in parts) < LEAST_ROWS:
        return None
    electrical, mechanical, motion = (np.vstack([part[k] for part in parts]) for k in range(3))
    return Rows(electrical, mechanical, motion, tuple(part[0].shape[0] for part in parts))


def _demanded(window: Window, signals: AlignedSignals, lowpass_hz: float) -> Float:
    """Return [w, Dw, DDw, sign w] (n, 4) that the demand gives: through a low-pass, and the drive's lag.

    The lag is what three coefficients on the demanded speed and its derivatives make of it; they are fitted to the
    measured speed over the whole window, which leaves nothing of its noise in the instruments.
    """
    dt = window.dt_s
    speed = np.append(np.diff(fill_forward(window.demand_mm)), 0.0) / dt * (2 * math.pi / window.pitch_mm)
    speed = filter_zero_phase(speed, min(lowpass_hz, SMOOTH_HZ), dt)
    rate = differentiate_signal(speed, dt)
    jerk = differentiate_signal(rate, dt)
    basis = np.column_stack([speed, rate, jerk])
    known = np.isfinite(basis).all(axis=1) & np.isfinite(signals.speed)
    share = solve_least_squares(basis[known], signals.speed[known])[0] if known.any() else np.zeros(3)
    followed = basis @ share
    rate = differentiate_signal(followed, dt)
    return np.column_stack([followed, rate, differentiate_signal(rate, dt), np.sign(followed)])


def fit(rows: Rows) -> Float:
    """Return [L, R, K, Jt, ft, Cd] (6,), NaN where the equations cannot be solved."""
    if not rows.finite:
        return np.full(6, np.nan)
    theta = solve_two_steps(rows.electrical, rows.mechanical)[0]
    for _ in range(REFINEMENTS):
        if not np.isfinite(theta).all() or theta[2] == 0.0:
            return np.full(6, np.nan)
        one, two = rows.instruments(theta)
        first = _paired(one, rows.electrical[:, 1:]) @ (one.T @ rows.electrical[:, 0])
        second = _paired(two, rows.mechanical[:, 1:]) @ (two.T @ (rows.mechanical[:, 0] * first[2]))
        theta = np.concatenate([first, second])
    return theta


def _paired(instruments: Float, regressor: Float) -> Float:
    """Return the (pseudo-)inverse (3, 3) of Z' phi."""
    cross, scale = _scaled(instruments, regressor)
    return (np.linalg.pinv(cross) if np.isfinite(cross).all() else np.full_like(cross, np.nan)) / scale.T


def _scaled(instruments: Float, regressor: Float) -> tuple[Float, Float]:
    """Return Z' phi (3, 3) for columns of equal length, and the lengths' products (3, 3)."""
    lengths = [np.sqrt((part * part).sum(axis=0)) for part in (instruments, regressor)]
    scale: Float = np.outer(*(np.where(length > 0, length, 1.0) for length in lengths))
    return instruments.T @ regressor / scale, scale


def _condition(instruments: Float, regressor: Float) -> float:
    """Return the condition number that compares with that of a regressor: the root of Z' phi's."""
    powers = np.linalg.svd(_scaled(instruments, regressor)[0], compute_uv=False)
    return math.sqrt(powers[0] / powers[-1]) if powers[-1] > 0 else math.inf


def _finish(rows: Rows, theta: Float, windows: Sequence[Window], settings: Identification) -> Estimate:
    """Return the checked estimate with the sandwich covariance of both steps."""
    one, two = rows.instruments(theta)
    residuals = compute_residuals(theta, rows.electrical, rows.mechanical)
    window = windows[0]
    noise, impulse, slope = propagate_sensor_noise(windows, settings)
    gammas = _gammas(theta, residuals, impulse, slope, noise)
    bread = _bread(rows, one, two)
    covariance = bread @ compute_score_covariance([one, two], gammas, rows.lengths) @ bread.T
    covariance += np.diag(np.square(OPEN_SHARE * theta))
    alias = estimate_aliasing_doubt(window.voltage_sampling, window.dt_s)
    covariance += np.diag(np.square(alias[PARAMETER_ORDER] * theta))
    condition = max(_condition(one, rows.electrical[:, 1:]), _condition(two, rows.mechanical[:, 1:]))
    return build_two_step_estimate(NAME, theta, covariance, residuals, condition, rows.mechanical)


def _gammas(
    theta: Float, residuals: tuple[Float, Float], impulse: Float, slope: Float, noise: Float
) -> list[list[Float]]:
    """Return the residuals' covariances by lag: sensor noise through known filters, larger if residuals show so."""
    others = compute_residual_autocovariances(theta, impulse, slope, np.append(0.0, noise[1:]))[0][0].max()
    shown = float(np.mean(residuals[0] ** 2) - others) / float(impulse @ impulse)
    noise = np.append(max(shown, LEAST_VOLTAGE_SHARE * noise[0]), noise[1:])
    gammas = compute_residual_autocovariances(theta, impulse, slope, noise)
    expected = [gammas[k][k][gammas[k][k].size // 2] for k in (0, 1)]
    excess = [max(1.0, float(np.mean(e * e) / g)) for e, g in zip(residuals, expected, strict=True)]
    return [[gammas[a][b] * math.sqrt(excess[a] * excess[b]) for b in (0, 1)] for a in (0, 1)]


def _bread(rows: Rows, one: Float, two: Float) -> Float:
    """Return the inverse (6, 6) of the stacked equations: the second step uses K of the first."""
    slope = np.zeros((6, 6))
    slope[:3, :3] = one.T @ rows.electrical[:, 1:]
    slope[3:, 3:] = two.T @ rows.mechanical[:, 1:]
    slope[3:, 2] = -two.T @ rows.mechanical[:, 0]
    lengths = [np.sqrt((part * part).sum(axis=0)) for part in (one, two)]
    fitted = [np.sqrt((part[:, 1:] ** 2).sum(axis=0)) for part in (rows.electrical, rows.mechanical)]
    left, right = (np.concatenate(parts) for parts in (lengths, fitted))
    left, right = np.where(left > 0, left, 1.0), np.where(right > 0, right, 1.0)
    inverse: Float = np.linalg.pinv(slope / np.outer(left, right)) / np.outer(right, left)
    return inverse
