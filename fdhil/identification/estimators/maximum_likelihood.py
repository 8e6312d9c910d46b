"""Estimates all six parameters together from noisy signals: maximum likelihood by Kalman innovations.

The voltage is noisy too. The innovations undo the drive's filtering of that noise: they are white, and the sum of their
squares is the exponent of the likelihood. The filter depends on the parameters: held fixed, it would mistake noise for
voltage and make L too large wherever the demand is smooth.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.estimators import least_squares
from fdhil.identification.identifiability import is_admissible, withhold_unidentifiable
from fdhil.identification.kalman import DELAY, JT, VOLTAGE, K, L, R
from fdhil.identification.likelihood_fit import (
    LikelihoodFit,
    build_problem,
    compute_jacobian,
    estimate_typical_sizes,
    exclude_delay,
    fit_parameters_and_noise,
    run_gauss_newton,
    set_delay,
)
from fdhil.identification.low_rate_voltage.likelihood_ascent import LowRateLikelihood, find_likelier_delay
from fdhil.identification.low_rate_voltage.low_rate_innovations import sum_by_sample
from fdhil.identification.low_rate_voltage.starting_values import (
    estimate_start,
    fit_current_walk,
    fit_low_rate_least_squares,
)
from fdhil.identification.low_rate_voltage.within_sample import (
    add_simulated_current,
    add_within_sample_doubt,
    compute_table_residual_mm,
    is_determined_by_loops,
)
from fdhil.identification.model_doubts import estimate_model_doubts
from fdhil.identification.normal_equations import invert_symmetric, solve_least_squares
from fdhil.identification.prepared_motion import UNKNOWN_MODE, Motion, prepare_window
from fdhil.identification.robust_covariance import (
    TESTED_LAGS,
    compute_robust_covariance,
    estimate_aliasing_doubt,
    is_coloured,
)
from fdhil.identification.speed_alignment import align_speed_to_samples
from fdhil.identification.term_estimates import append_terms
from fdhil.identification.term_regressors import FIRST_TERM
from fdhil.identification.term_selection import add_terms
from fdhil.identification.voltage_delay import (
    MOST_DELAY,
    add_delay_doubt,
    differentiate_by_delay,
    estimate_coarse_delay,
)
from fdhil.records import PARAMETERS, Estimate, Float, Result, Window

__all__ = [
    "LikelihoodFit",
    "build_problem",
    "compute_jacobian",
    "estimate",
    "estimate_typical_sizes",
    "fit_parameters_and_noise",
    "fit_windows",
    "run_gauss_newton",
]
MAXIMUM_LIKELIHOOD = "maximum_likelihood"
INSTANT_DELAY = 0.5  # of a sample
RESEMBLING = 0.5  # share of a delay or lost voltage that may be something else: coupled d and q axes
TURNS = 2  # iterations of parameters and simulated loops
FLOORS = np.array([1e-4, 1e-4, 1e-9])  # of R, K and Jt
LEAST_TIME_CONSTANT_S = 1e-4  # of the winding: noise may drive the starting L below 0


def choose_starting_point(first: Float | None) -> Float | None:
    """Return theta (7,) to start from, without delay; None where ``first`` is missing or not a possible drive."""
    if first is None or not np.isfinite(first).all() or (first[[R, K, JT]] <= FLOORS).any():
        return None
    theta = np.append(first, 0.0)
    theta[L] = max(theta[L], LEAST_TIME_CONSTANT_S * theta[R])
    return theta


def fit_windows(windows: Sequence[Window], settings: Identification) -> LikelihoodFit | None:
    """Fit windows of one drive together; None without a start.

    A delay of the voltage is fitted too where it is significant, or where the voltage has a clock of its own.
    """
    windows = [align_speed_to_samples(w, settings.speed_source) for w in windows]
    slow = [w for w in windows if w.slow_voltage is not None]
    if slow:
        return _fit_low_rate(slow, settings)
    usable = [w for w in windows if w.voltage_v is not None]
    signals = [least_squares.align_signals(w, settings) for w in usable]
    start = choose_starting_point(least_squares.estimate_raw_values(signals, [w.dt_s for w in usable]))
    if start is None:
        return None
    motions = [add_within_sample_doubt(prepare_window(w), start, w.current_off_a) for w in usable]
    delays = [estimate_coarse_delay(s, w.dt_s) for s, w in zip(signals, usable, strict=True)]
    command = settings.voltage_source != "terminals"
    if any(w.voltage_delay_s is not None for w in usable):
        return add_terms(_fit_separate(motions, start, delays), command, build_estimate)
    start[DELAY] = float(np.median(delays))
    # without a delay of whole samples, a shorter one is a candidate like the terms, which it resembles
    return _add_terms_and_delay(
        fit_parameters_and_noise(motions, start, range(6) if start[DELAY] == 0.0 else range(7)), command
    )


def refit_with_loops(
    base: LikelihoodFit, window: Window, settings: Identification, axis: Axis, sync_period_s: float | None
) -> LikelihoodFit:
    """Return the fit of a window with long samples, refined by simulating the ``axis``' loops within them.

    ``base`` is the fit without. It is returned where the loops do not apply, and where the closed loop explains the
    measured position no better: then the loops are wrong.
    """
    begun = base.problem.motions[0]
    known = np.isfinite(window.demand_mm).all() and np.isfinite(window.position_mm).all()
    if not (known and base.converged and is_determined_by_loops(begun, sync_period_s)):
        return base
    result, plain = base, replace(begun, courses=())
    for _ in range(TURNS):
        motion = add_simulated_current(plain, result.theta, axis, window.demand_mm)
        result = fit_parameters_and_noise([motion], set_delay(result.theta[: DELAY + 1], 0.0), range(DELAY))
        if not result.converged:
            return base
    result = _add_terms_and_delay(result, settings.voltage_source != "terminals")
    missed, missed_before = (compute_table_residual_mm(f.theta, axis, window) for f in (result, base))
    return result if missed < missed_before else base


def _add_terms_and_delay(base: LikelihoodFit, command: bool) -> LikelihoodFit:
    return add_terms(add_delay_doubt(base), command, build_estimate, delayed=True)


def _fit_separate(motions: Sequence[Motion], start: Float, delays: Sequence[float]) -> LikelihoodFit:
    """Fit windows whose voltage sensor has its own clock: each window has its own delay.

    The delay left after alignment by counters is known to a fraction of a sample only. It is fitted in every window
    from its coarse value (the counters may be a whole sample off) and removed; the rest is fitted once more with the
    parameters, whose intervals then contain it.
    """
    alone = [_fit_alone(m, np.append(start[:6], delay)) for m, delay in zip(motions, delays, strict=True)]
    if len(motions) == 1:
        return replace(alone[0], delay_doubt_s=estimate_instant_doubt_s(motions[0]))
    aligned = [m.shift_voltage(f.theta[DELAY]) if f.converged else m for m, f in zip(motions, alone, strict=True)]
    together = fit_parameters_and_noise(aligned, np.append(alone[0].theta[:6], 0.0), range(7))
    return replace(together, delay_doubt_s=estimate_instant_doubt_s(motions[0]))


def _fit_alone(motion: Motion, start: Float) -> LikelihoodFit:
    found = fit_parameters_and_noise([motion], start, range(7))
    if motion.slow is None or not is_admissible(found.theta):
        return found
    here = LowRateLikelihood(found.problem.motions, found.problem.noises)
    better = find_likelier_delay(here, found.theta, found.information, motion.slow.period_s)
    if better is None:
        return found
    other = fit_parameters_and_noise([motion], better, range(7))
    there = LowRateLikelihood(other.problem.motions, other.problem.noises).compute_innovations(other.theta)
    return other if there.cost < here.compute_innovations(found.theta).cost else found


def estimate_instant_doubt_s(motion: Motion) -> float:
    """Return the standard deviation (s) of a delay from instants of a low-rate voltage, due to regulators in step with
    them.
    """
    return INSTANT_DELAY * motion.dt_s if motion.slow is not None and motion.voltage_sampling == "instant" else 0.0


def _fit_low_rate(windows: Sequence[Window], settings: Identification) -> LikelihoodFit | None:
    begun = estimate_start(windows, settings)
    if begun is None:
        return None
    first, delays, motions = begun
    theta = choose_starting_point(first)
    if theta is None:
        return None
    walking = [fit_current_walk(m, np.append(theta[:6], delay)) for m, delay in zip(motions, delays, strict=True)]
    return _fit_separate(walking, theta, delays)


def estimate_doubts(result: LikelihoodFit, inverse: Float) -> Float:
    """Return systematic doubts: one standard deviation (k, q) of the entries of theta.

    An interval mean leaves the voltage's waveform within the sample open: its largest part, the back-EMF's ramp, is
    known except for the regulators' response (first column); what resembles a delay is the second. Both are common to
    all windows of a drive, so more windows do not reduce them.
    """
    effects = result.problem.compute_waveform_effects(result.theta)
    columns = np.zeros((result.theta.size, 1 + effects.shape[1]))
    free = list(result.free)
    columns[free, 0] = inverse @ (result.jacobian.T @ effects[:, 0])
    columns[free, 2:] = inverse @ (result.jacobian.T @ effects[:, 1:])
    if result.prior.size:
        columns = np.column_stack([columns, _estimate_prior_doubts(result, inverse)])
    if result.delay_doubt_s > 0.0:
        others = exclude_delay(free)
        unsure = max(result.delay_doubt_s, _estimate_delay_ambiguity_s(result))
        columns[others, 1] = (
            -unsure * solve_least_squares(result.jacobian_without_delay, differentiate_by_delay(result))[0]
        )
        columns[DELAY, 1] = result.delay_doubt_s
    return columns


def _estimate_voltage_ambiguity(result: LikelihoodFit) -> Float:
    courses, columns = result.problem.motions[0].courses, []
    for k, j in enumerate(result.free):
        if j < FIRST_TERM or courses[j - FIRST_TERM].kind != VOLTAGE:
            continue
        others = [m for m in range(len(result.free)) if m != k]
        column = np.zeros(result.theta.size)
        column[[result.free[m] for m in others]] = solve_least_squares(
            result.jacobian[:, others], result.jacobian[:, k]
        )[0]
        columns.append(RESEMBLING * result.theta[j] * column)
    return np.stack(columns, axis=1) if columns else np.zeros((result.theta.size, 0))


def _estimate_delay_ambiguity_s(result: LikelihoodFit) -> float:
    delay_s, first = abs(float(result.theta[DELAY])), result.problem.motions[0]
    return RESEMBLING * delay_s if first.slow is None and delay_s <= MOST_DELAY * first.dt_s else 0.0


def _estimate_prior_doubts(result: LikelihoodFit, inverse: Float) -> Float:
    asked = np.flatnonzero(result.prior)
    columns = np.zeros((result.theta.size, asked.size))
    columns[list(result.free)] = inverse[:, asked] * (result.prior * result.prior_std)[asked]
    return columns


def estimate(windows: Sequence[Window], settings: Identification) -> Estimate:
    """Fit one window, or several of one drive together, with a delay where it is significant.

    Where least squares finds no possible drive, that estimate is returned: it shows what is wrong.
    """
    result = fit_windows(windows, settings)
    if result is None and any(w.slow_voltage is not None for w in windows):
        return fit_low_rate_least_squares(windows, settings)
    if result is None:
        return least_squares.estimate(windows, settings)
    return build_estimate(result)


def compute_robust_inverse(result: LikelihoodFit, inverse: Float) -> Float:
    """Return ``inverse`` (k, k), or the covariance valid for coloured innovations or uneven variance."""
    motions = result.problem.motions
    parts = result.split_by_window(result.residuals)
    known = [(m.mode != UNKNOWN_MODE) & m.observed for m in motions]
    rows = [e[: 2 * m.n].reshape(-1, 2)[where] for m, e, where in zip(motions, parts, known, strict=True)]
    sampled = [e[2 * m.n :, None] for m, e in zip(motions, parts, strict=True)]
    if not any(is_coloured(e) for e in (*rows, *sampled)):
        return inverse
    slopes = result.split_by_window(result.jacobian)
    scores = [
        sum_by_sample(m, float(result.theta[DELAY]), j * e[:, None])
        for m, j, e in zip(motions, slopes, parts, strict=True)
    ]
    plain = [
        (j.reshape(m.n, 2, -1), e)
        for m, j, e in zip(motions, slopes, rows, strict=True)
        if m.slow is None and len(e) >= 4 * TESTED_LAGS
    ]
    return compute_robust_covariance(result.information, scores, plain)


@lru_cache(maxsize=4)
def build_estimate(result: LikelihoodFit) -> Estimate:
    """Return the fit as an estimate with its covariance."""
    inverse, condition = invert_symmetric(result.information)
    kept = [k for k, j in enumerate(result.free) if j != DELAY]
    entries = [j for j in result.free if j != DELAY]
    first = result.problem.motions[0]
    alias = np.zeros(len(entries))
    alias[: len(PARAMETERS)] = estimate_aliasing_doubt(first.voltage_sampling, first.voltage_period_s)
    systematic = estimate_doubts(result, inverse)
    held = compute_robust_inverse(result, inverse)
    late = DELAY in result.free
    at = result.free.index(DELAY) if late else 0
    chance, beyond = (part[np.ix_(kept, kept)] for part in (inverse, held - inverse))
    own = systematic[entries]
    if result.prior.size:  # the prior is among the doubts that windows have in common
        chance = chance - inverse[kept] @ np.diag(result.prior) @ inverse[:, kept]
    values = result.theta[entries]
    answer = Estimate(
        method=MAXIMUM_LIKELIHOOD,
        names=PARAMETERS,
        values=values[: len(PARAMETERS)],
        covariance=chance + own @ own.T + np.diag(np.square(alias * values)),
        residuals=result.split_by_equation(),
        result=Result.OK if result.converged else Result.DIVERGED,
        delay_s=float(result.theta[DELAY]) if late else None,
        delay_std_s=float(np.sqrt(held[at, at] + systematic[DELAY] @ systematic[DELAY])) if late else None,
        systematic=own,
    )
    if first.courses or first.speed_late is not None:
        answer, beyond = append_terms(answer, result, values, beyond)
    # identifiability follows from the information; coloured residuals are not a lack of excitation
    top_rad_s, top_a = (
        max(float(np.abs(getattr(m, n)).max()) for m in result.problem.motions) for n in ("speed", "current")
    )
    judged = withhold_unidentifiable(answer, condition, top_rad_s, abs(float(result.theta[K])) * top_a)
    if judged.names != answer.names:  # all parameters are withheld
        return judged
    assert judged.systematic is not None
    left = np.column_stack([estimate_model_doubts(result), _estimate_voltage_ambiguity(result)])[: len(PARAMETERS)]
    left = np.pad(left, ((0, len(judged.names) - len(left)), (0, 0)))
    return replace(
        judged,
        covariance=judged.covariance + beyond + left @ left.T,
        systematic=np.column_stack([judged.systematic, left]),
    )
