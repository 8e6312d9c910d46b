"""Fits [2] alone where there is no voltage: Jt, ft and Cd from current and position, with a given K.

Least squares on K i = Jt dw/dt + ft w + Cd sign(w) through one filter, and on Stribeck friction and screw ripples that
the Bayesian information criterion prefers (Schwarz 1978). The torque's slope (a late current) and the acceleration's
second derivative (a compliant screw, to first order) are always fitted, to avoid their bias.

Residuals are dominated by unmodelled, coloured friction, not by sensor noise: the intervals use the variance of the
scores (Newey and West 1987), widened for its own scatter (Kiefer and Vogelsang 2005).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from fdhil.config import Identification
from fdhil.identification.identifiability import create_empty_estimate, withhold_unidentifiable
from fdhil.identification.normal_equations import invert_gram, solve_least_squares
from fdhil.identification.robust_covariance import take_larger_variance
from fdhil.identification.torque_samples import TorqueSamples, extract_torque_samples
from fdhil.records import PARAMETERS, RATIOS, Estimate, Float, Reason, Result, Window, compute_rms

METHOD = "least_squares"
DATA_SHEET_PARAMETERS = ("R", "L", "K")
LEAST_ROWS = 32
BASE = ("Jt", "delay", "give", "ft", "Cd")
STRIBECK_SHARES = (0.02, 0.03, 0.05, 0.08, 0.12, 0.18, 0.27)  # of the top speed
SCREW_ORDERS = (1, 2)
TERMS = ("stribeck", *(f"ripple_screw_{order}" for order in SCREW_ORDERS))
WORTH = 0.005  # of the torque's RMS: least effect of a term, a tenth of the allowed residual
SUMMED_SHARE = 0.1  # of a window's samples: range of correlation of its residuals
WIDENED = 2.9694 / 1.96  # per share, of the 95 % interval: Kiefer and Vogelsang 2005, Bartlett's weights
OPEN_SHARE = 3e-4  # of Jt: doubt of a current that is read once a sample
OPEN_SHARE_ROWS = 3e-5  # the same at 1 ms; it grows with the square of the sample
NO_VOLTAGE = Reason("LowExcitation", "there is no voltage, so [1] gives no R and L", "connect the voltage sensor")
NO_K = Reason(
    "LowExcitation",
    "there is no voltage, so [1] gives no R, L and K, and without K the rest is known in amperes only",
    "give the header torque_constant_nm_per_a, or the axis' nominal values with --config",
)


@dataclass(frozen=True, slots=True, eq=False)
class TorqueTerm:
    """A candidate term: its ``names``, and one column (m,) for each linear value.

    ``slope`` (m,) is the derivative of the torque of one unit by a nonlinear value, such as the Stribeck speed ``at``.
    """

    names: tuple[str, ...]
    columns: Float
    at: float | None = None
    slope: Float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TorqueFit:
    """[2] in amperes, fitted to the samples of a window: ``design`` (m, k) and ``current`` (m,).

    ``theta`` (k,) are the columns' amplitudes: those of ``BASE``, then of each of ``terms``. ``shifts`` (k,) are their
    changes with a significant term that was not worth adding, by its name.
    """

    rows: TorqueSamples
    design: Float
    current: Float
    theta: Float
    terms: tuple[TorqueTerm, ...]
    shifts: Mapping[str, Float] = field(default_factory=dict)

    @property
    def residual(self) -> Float:
        """The residual of the current (m,), A."""
        return self.current - self.design @ self.theta

    @property
    def unexplained(self) -> float:
        """RMS of the residual as a share of the current's."""
        return compute_rms(self.residual) / max(compute_rms(self.current), 1e-300)


@lru_cache(maxsize=8)
def fit_torque(window: Window, settings: Identification) -> TorqueFit | None:
    """Fit [2] and its terms to a window; None with hardly any samples in motion. Cached for the checks."""
    rows = extract_torque_samples(window, settings)
    if rows is None or rows.count < LEAST_ROWS:
        return None
    base = np.column_stack([rows.acceleration, rows.jerk, rows.snap, rows.speed])[rows.usable]
    design, current = np.column_stack([base, rows.filter_regressors(rows.side[None])]), rows.current[rows.usable]
    if not (np.isfinite(design).all() and np.isfinite(current).all()):
        return None
    return _add_worthwhile_terms(TorqueFit(rows, design, current, solve_least_squares(design, current)[0], ()))


def _add_worthwhile_terms(fitted: TorqueFit) -> TorqueFit:
    news = count_effective_samples(fitted.residual)
    while True:
        wanted = _rank_candidate_fits(fitted, news)
        torque, least = fitted.design @ fitted.theta, WORTH * compute_rms(fitted.current)
        worth = [other for other in wanted if compute_rms(other.design @ other.theta - torque) > least]
        if not worth:
            size = fitted.theta.size
            shifts = {other.terms[-1].names[0]: other.theta[:size] - fitted.theta for other in wanted}
            return replace(fitted, shifts=shifts)
        fitted = worth[0]


def _rank_candidate_fits(fitted: TorqueFit, news: float) -> list[TorqueFit]:
    """Return the fits with one additional term that the criterion prefers, the best of each kind, best first."""
    power, found = float(np.square(fitted.residual).sum()), []
    for term in list_candidate_terms(fitted):
        design = np.column_stack([fitted.design, term.columns])
        theta, _ = solve_least_squares(design, fitted.current)
        tried = replace(fitted, design=design, theta=theta, terms=(*fitted.terms, term))
        left = float(np.square(tried.residual).sum())
        gain = news * np.log(power / max(left, 1e-300)) - len(term.names) * np.log(news)
        if gain > 0.0:
            found.append((gain, tried))
    found.sort(key=lambda pair: -pair[0])
    best: dict[tuple[str, ...], TorqueFit] = {}
    for _, tried in found:
        best.setdefault(tried.terms[-1].names, tried)
    return list(best.values())


def count_effective_samples(e: Float) -> float:
    """Return the effective number of residuals (n,): n / (1 + 2 sum rho), rho up to its first zero."""
    size = 1 << (2 * e.size).bit_length()
    correlation = np.fft.irfft(np.abs(np.fft.rfft(e, size)) ** 2, size)[: e.size]
    if correlation[0] <= 0.0:
        return float(e.size)
    rho = correlation / correlation[0]
    end = int(np.argmax(rho <= 0.0)) or e.size
    return max(float(e.size / (1.0 + 2.0 * rho[1:end].sum())), 8.0)


def list_candidate_terms(fitted: TorqueFit) -> list[TorqueTerm]:
    """Return the candidate terms that these samples can determine."""
    rows, joined = fitted.rows, {name for term in fitted.terms for name in term.names}
    found = []
    if "stribeck" not in joined:
        speed = np.abs(rows.speed[rows.usable])
        found += [
            _build_stribeck_term(rows, share * speed.max())
            for share in STRIBECK_SHARES
            if share * speed.max() > speed.min()
        ]
    for order in SCREW_ORDERS:
        name = f"ripple_screw_{order}"
        if name not in joined:
            both = rows.filter_regressors(np.stack([np.sin(order * rows.angle), np.cos(order * rows.angle)]))
            found.append(TorqueTerm((name, f"{name}_phase"), both))
    return found


def _build_stribeck_term(rows: TorqueSamples, speed_rad_s: float) -> TorqueTerm:
    share = rows.speed / speed_rad_s
    course = rows.side * np.exp(-np.square(share))
    both = rows.filter_regressors(np.stack([course, course * 2.0 * share**2 / speed_rad_s]))
    return TorqueTerm(("stribeck", "stribeck_speed"), both[:, :1], speed_rad_s, both[:, 1])


def build_torque_estimate(window: Window, fitted: TorqueFit | None, known: Mapping[str, float]) -> Estimate:
    """Return the estimate of a window's fit, with the K of the recording itself, else the one ``known``.

    ``known`` may hold K, R and L of the data sheet: they are ``given`` in the estimate. Unknown R and L are missing.
    Without K all six are missing, and ``RATIOS`` follow them.
    """
    if fitted is None:
        text = "hardly any sample in motion lies beyond the low-pass's reach from standstill"
        reason = Reason("LowExcitation", text, "record a longer rapid or raise lowpass_hz")
        return create_empty_estimate(METHOD, Result.UNDER_EXCITED, reason)
    own = window.torque_constant_nm_per_a
    given = dict(known) if own is None else {**known, "K": own}
    return _scale_by_constant(fitted, given) if "K" in given else _build_ratio_estimate(fitted)


def estimate_current_lag_s(fitted: TorqueFit) -> tuple[float, float]:
    """Return the lag of the current against the motion (negative: early), and its standard deviation."""
    inertia, lag = float(fitted.theta[0]), float(fitted.theta[1])
    if not inertia > 0.0:
        return 0.0, np.inf
    covariance = _estimate_covariance(fitted)
    return -lag / inertia, float(np.sqrt(covariance[1, 1])) / inertia


def _estimate_covariance(fitted: TorqueFit) -> Float:
    """Return the covariance (k + s, k + s) of the amplitudes and of the nonlinear values.

    In every direction the larger of two counts: by the scores, and by as many residuals with this correlation.
    """
    slopes = [t.slope * fitted.theta[_index_first_column(fitted, t)] for t in fitted.terms if t.slope is not None]
    design = np.column_stack([fitted.design, *slopes])
    inverse, _ = invert_gram(design)
    meat = _estimate_long_run_variance(design * fitted.residual[:, None], round(SUMMED_SHARE * len(design)))
    meat *= (1.0 + WIDENED * SUMMED_SHARE) ** 2
    power = max(float(np.square(fitted.residual).sum()), 1e-12 * float(np.square(fitted.current).sum()))
    correlated = design.T @ design * power / max(count_effective_samples(fitted.residual) - design.shape[1], 1.0)
    scale = np.sqrt(np.diag(correlated))
    scaled = np.outer(scale, scale)
    covariance: Float = inverse @ (take_larger_variance(meat / scaled, correlated / scaled) * scaled) @ inverse.T
    return covariance


def _estimate_long_run_variance(scores: Float, lags: int) -> Float:
    meat = scores.T @ scores
    for lag in range(1, lags + 1):
        shifted = scores[lag:].T @ scores[:-lag]
        meat += (1.0 - lag / (lags + 1)) * (shifted + shifted.T)
    return meat


def _index_first_column(fitted: TorqueFit, term: TorqueTerm) -> int:
    at = next(k for k, other in enumerate(fitted.terms) if other is term)
    return len(BASE) + sum(int(t.columns.shape[1]) for t in fitted.terms[:at])


def _scale_by_constant(fitted: TorqueFit, given: Mapping[str, float]) -> Estimate:
    values, rates = _list_values(fitted)
    doubts = _estimate_doubts(fitted, rates)
    covariance = rates @ _estimate_covariance(fitted) @ rates.T + doubts @ doubts.T
    units = np.array([1.0 if name.endswith(("_speed", "_phase")) else given["K"] for name in values])
    whole = np.zeros((len(DATA_SHEET_PARAMETERS) + len(values),) * 2)
    whole[len(DATA_SHEET_PARAMETERS) :, len(DATA_SHEET_PARAMETERS) :] = covariance * np.outer(units, units)
    # identifiability is checked for the fitted parameters only: given and missing ones have no interval
    sheet = [given.get(name, 1.0) for name in DATA_SHEET_PARAMETERS]
    answer = Estimate(
        method=METHOD,
        names=(*DATA_SHEET_PARAMETERS, *values),
        values=np.concatenate([sheet, units * np.array(list(values.values()))]),
        covariance=whole,
        residuals={"mechanical": fitted.residual},
        result=Result.OK,
        given=tuple(name for name in DATA_SHEET_PARAMETERS if name in given),
        systematic=np.vstack([np.zeros((len(DATA_SHEET_PARAMETERS), doubts.shape[1])), units[:, None] * doubts]),
    )
    judged = withhold_unidentifiable(answer, invert_gram(fitted.design)[1], float(np.abs(fitted.rows.speed).max()))
    return _mark_missing(judged, [name for name in DATA_SHEET_PARAMETERS if name not in given])


def _mark_missing(estimate: Estimate, names: Sequence[str]) -> Estimate:
    values, covariance = estimate.values.copy(), estimate.covariance.copy()
    for name in names:
        k = estimate.names.index(name)
        values[k] = covariance[k, :] = covariance[:, k] = np.nan
    missing = {**dict.fromkeys(names, NO_VOLTAGE), **estimate.missing}
    result = Result.UNDER_EXCITED if names and estimate.result is Result.OK else estimate.result
    return replace(estimate, values=values, covariance=covariance, missing=missing, result=result)


def _build_ratio_estimate(fitted: TorqueFit) -> Estimate:
    values, rates = _list_values(fitted)
    known, k = len(RATIOS), len(PARAMETERS)
    whole = np.full((k + known, k + known), np.nan)
    doubts = _estimate_doubts(fitted, rates)
    whole[k:, k:] = (rates @ _estimate_covariance(fitted) @ rates.T + doubts @ doubts.T)[:known, :known]
    return Estimate(
        method=METHOD,
        names=(*PARAMETERS, *RATIOS),
        values=np.concatenate([np.full(k, np.nan), list(values.values())[:known]]),
        covariance=whole,
        residuals={"mechanical": fitted.residual},
        result=Result.UNDER_EXCITED,
        missing=dict.fromkeys(PARAMETERS, NO_K),
    )


def _list_values(fitted: TorqueFit) -> tuple[dict[str, float], Float]:
    inertia, lag, _, viscous, dry = fitted.theta[: len(BASE)]
    named = {"Jt": float(inertia - lag / inertia * viscous), "ft": float(viscous), "Cd": float(dry)}
    size, others = fitted.theta.size, sum(t.slope is not None for t in fitted.terms)
    rates = [np.eye(size + others)[k] for k in (0, 3, 4)]
    for term in fitted.terms:
        k, unit = _index_first_column(fitted, term), np.eye(size + others)
        if term.at is not None:
            named |= dict(zip(term.names, (float(fitted.theta[k]), term.at), strict=True))
            rates += [unit[k], unit[size]]  # there is only one such term
            continue
        sine, cosine = fitted.theta[k : k + 2]
        whole = float(np.hypot(sine, cosine))
        named |= dict(zip(term.names, (whole, float(np.arctan2(cosine, sine))), strict=True))
        rates.append((sine * unit[k] + cosine * unit[k + 1]) / whole)
        rates.append((sine * unit[k + 1] - cosine * unit[k]) / whole**2)
    return named, np.array(rates)


def _estimate_doubts(fitted: TorqueFit, rates: Float) -> Float:
    """Return the doubts (v, q) of each value, common to all windows of a drive: one deviation a column.

    Noise on the acceleration reduces Jt; each significant term that was not added would move all values.
    """
    power = float(np.mean(np.square(fitted.design[:, 0])))
    noise = fitted.rows.error_rad_s2**2 / max(power, 1e-300)
    unread = OPEN_SHARE + OPEN_SHARE_ROWS * (1e3 * fitted.rows.dt_s) ** 2
    inertia = np.eye(len(rates))[0] * abs(fitted.theta[0]) * np.hypot(unread, noise)
    none = np.zeros(fitted.theta.size)
    shifts = [rates[:, : none.size] @ fitted.shifts.get(name, none) for name in TERMS]
    return np.column_stack([inertia, *shifts])
