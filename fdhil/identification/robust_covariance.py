"""Computes covariances that remain valid when residuals are coloured and regressors are noisy."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from fdhil.identification.filtering import convolve_columns, find_fft_size
from fdhil.identification.normal_equations import compute_inverse_root, solve_least_squares
from fdhil.records import Float, VoltageSampling

Complex = npt.NDArray[np.complex128]
TESTED_LAGS = 25
SUMMED_LAGS = 50  # samples over which innovations may correlate
COLOUR_ROWS = 10  # order of the autoregression: a window of 0.1 s determines no more weights
VARIANCE_PARTS = 10
BEYOND_CHANCE = 5.0  # standard deviations: some seventy statistics a window


def compute_score_covariance(
    blocks: Sequence[Float], gammas: Sequence[Sequence[Float]], lengths: Sequence[int]
) -> Float:
    """Return the covariance (k, k) of the stacked scores sum_t phi_t e_t of regressions over the same samples.

    ``blocks`` are regressors (m, k_j) of windows of ``lengths``; ``gammas[a][b]`` (2 H + 1,) is the covariance of
    residual a at t with residual b at t + lag, for lags -H to H. The residuals are sensor noise through known filters,
    so their covariance is known; an estimate from the residuals would leak power that a derivative does not have.
    """
    sizes = np.cumsum([0, *(b.shape[1] for b in blocks)])
    meat = np.zeros((sizes[-1], sizes[-1]))
    stops = np.cumsum(lengths).tolist()
    for start, stop in zip([0, *stops[:-1]], stops, strict=True):
        for a, left in enumerate(blocks):
            for b, right in enumerate(blocks):
                pulled = convolve_columns(right[start:stop], gammas[a][b][::-1])
                meat[sizes[a] : sizes[a + 1], sizes[b] : sizes[b + 1]] += left[start:stop].T @ pulled
    return meat


def compute_residual_autocovariances(theta: Float, impulse: Float, slope: Float, noise: Float) -> list[list[Float]]:
    """Return the autocovariances of the residuals of [5] (V) and of K times [6] (N.m) due to sensor noise.

    ``theta`` is [L, R, K, Jt, ft, Cd]; ``impulse`` and ``slope`` are the responses of the low-pass, and of low-pass and
    derivative, to one sample; ``noise`` (3,) are the variances of voltage, current and speed.
    """
    none = np.zeros_like(impulse)
    electrical = (impulse, -(theta[0] * slope + theta[1] * impulse), -theta[2] * impulse)
    mechanical = (none, theta[2] * impulse, -(theta[3] * slope + theta[4] * impulse))
    answers = (electrical, mechanical)
    return [
        [
            np.sum([v * np.correlate(q, p, "full") for v, p, q in zip(noise, one, other, strict=True)], axis=0)
            for other in answers
        ]
        for one in answers
    ]


def compute_two_step_covariance(
    electrical: Float, mechanical: Float, residuals: Sequence[Float], gammas: list[list[Float]], lengths: Sequence[int]
) -> Float:
    """Return the covariance (6, 6) of [L, R, K, Jt, ft, Cd] fitted in two steps.

    ``electrical`` (m, 4) is [u, Di, i, w], ``mechanical`` (m, 4) is [i, Dw, w, sign w]. The second step uses K of the
    first, so the scores of both are stacked. Residuals larger than the noise inflate the covariance.
    """
    phi_1, phi_2 = electrical[:, 1:], mechanical[:, 1:]
    expected = [gammas[k][k][gammas[k][k].size // 2] for k in (0, 1)]
    excess = [max(1.0, float(np.mean(e * e) / g)) for e, g in zip(residuals, expected, strict=True)]
    scaled = [[gammas[a][b] * np.sqrt(excess[a] * excess[b]) for b in (0, 1)] for a in (0, 1)]
    bread = _invert_normal_equations(phi_1, phi_2, mechanical[:, 0])
    return bread @ compute_score_covariance([phi_1, phi_2], scaled, lengths) @ bread.T


def is_coloured(innovations: Float) -> bool:
    """Return whether innovations (n, 2) are significantly coloured or of uneven variance along the window."""
    n = innovations.shape[0]
    if n < 4 * TESTED_LAGS:
        return False
    power = (innovations**2).sum(axis=0)
    size = 1 << (n + TESTED_LAGS).bit_length()  # zero-padded so that no lag wraps round
    spectrum = np.fft.rfft(innovations, size, axis=0)
    correlations = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[1 : TESTED_LAGS + 1] / power
    shares = np.array([(part**2).mean(axis=0) for part in np.array_split(innovations, VARIANCE_PARTS)]) * n / power
    # the mean of m squares of unit normals scatters by sqrt(2 / m)
    uneven = np.abs(shares - 1.0).max() / np.sqrt(2.0 * VARIANCE_PARTS / n)
    return bool(max(np.abs(correlations).max() * np.sqrt(n), uneven) > BEYOND_CHANCE)


def compute_robust_covariance(
    information: Float, scores: Sequence[Float], rows: Sequence[tuple[Float, Float]]
) -> Float:
    """Return the covariance (k, k) of a fit with ``information`` (k, k) whose windows have ``scores`` (n, k) by sample.

    ``rows`` has, for each window whose voltage is sampled with its other signals, the slopes (n, 2, k) of the
    innovations and the innovations (m, 2) at known friction. The variance of the scores is estimated by the scores
    (Newey and West 1987, with the cost of its own scatter after Kiefer and Vogelsang 2005), which is blind to
    correlation over a large part of the window, and by an autoregression of the innovations. The larger counts in every
    direction, at least the information.
    """
    root = compute_inverse_root(information)
    power, predicted = np.zeros((2, root.shape[1], root.shape[1]))
    for own in scores:
        power += estimate_long_run_variance(own @ root)
    for slopes, innovations in rows:
        predicted += _estimate_coloured_variance(
            slopes @ root, _estimate_spectrum_root(innovations, find_fft_size(2 * len(slopes)))
        )
    share = SUMMED_LAGS / sum(len(own) for own in scores)
    power *= (1.0 + 2.9694 / 1.96 * min(share, 1.0)) ** 2
    return root @ take_larger_variance(predicted, take_larger_variance(power, np.eye(len(power)))) @ root.T


def estimate_long_run_variance(scores: Float) -> Float:
    """Return the long-run variance (k, k) of the sum of correlated ``scores`` (n, k), with Bartlett's weights."""
    span = min(SUMMED_LAGS, len(scores) // 4) + 1
    sums = np.zeros((len(scores) + 2 * span, scores.shape[1]))
    np.cumsum(scores, axis=0, out=sums[span : span + len(scores)])
    sums[span + len(scores) :] = sums[span + len(scores) - 1]
    moving = sums[span:] - sums[:-span]  # the mean square of moving sums has these weights
    return moving.T @ moving / span


def _estimate_spectrum_root(innovations: Float, size: int) -> Complex:
    """Return a root (2, 2, size // 2 + 1) of the spectrum of innovations (n, 2), by a short autoregression."""
    n = len(innovations)
    before = np.hstack([innovations[COLOUR_ROWS - lag : n - lag] for lag in range(1, COLOUR_ROWS + 1)])
    weights, _ = solve_least_squares(before, innovations[COLOUR_ROWS:])
    left = innovations[COLOUR_ROWS:] - before @ weights
    news = left.T @ left / (n - 3 * COLOUR_ROWS)
    filters = np.concatenate([np.eye(2)[None], -weights.reshape(COLOUR_ROWS, 2, 2).transpose(0, 2, 1)])
    (a, b), (c, d) = np.fft.rfft(filters, size, axis=0).transpose(1, 2, 0)
    root = np.linalg.cholesky(news)
    rows = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    answer: Complex = np.einsum("abf,bc->acf", rows, root)
    return answer


def _estimate_coloured_variance(slopes: Float, root: Complex) -> Float:
    """Return the variance (k, k) of the sum of slopes (n, 2, k) times innovations with that ``root`` of a spectrum."""
    size = 2 * (root.shape[2] - 1)
    of_current, of_speed = np.fft.rfft(slopes.transpose(1, 2, 0), size)  # (k, f)
    weight = np.full(root.shape[2], math.sqrt(2.0))
    weight[[0, -1]] = 1.0
    answers = [(a.conj() * of_current + b.conj() * of_speed) * weight for a, b in root.transpose(1, 0, 2)]
    whole = np.concatenate([part for answer in answers for part in (answer.real, answer.imag)], axis=1)
    variance: Float = whole @ whole.T / size
    return variance


def take_larger_variance(one: Float, other: Float) -> Float:
    """Return the covariance (k, k) that is, in every direction, the larger of two; ``other`` is positive definite."""
    lower = np.linalg.cholesky(other)
    inverse = np.linalg.inv(lower)
    ratios, axes = np.linalg.eigh(inverse @ one @ inverse.T)
    turned = lower @ axes
    larger: Float = (turned * np.maximum(ratios, 1.0)) @ turned.T
    return larger


def estimate_aliasing_doubt(sampling: VoltageSampling, dt_s: float) -> Float:
    """Return the relative doubt (6,) of [R, L, K, Jt, ft, Cd] where a switching drive's voltage is sampled at instants.

    Current regulators respond within a sample, so an instant taken in step with them is not a mean: on the bench, L is
    off by 26 to 30 %, R by 3 %, K and Jt by 0.2 % at 1 ms, although the model fits the speed as well as ever.
    """
    doubt = np.zeros(6)
    if sampling == "instant":
        coarse = min(2.0, (dt_s / 1e-3) ** 2)
        doubt[:4] = 0.025 * coarse, 0.2, 0.0015 * coarse, 0.0015 * coarse
    return doubt


def _invert_normal_equations(phi_1: Float, phi_2: Float, current: Float) -> Float:
    slope = np.zeros((6, 6))
    slope[:3, :3] = phi_1.T @ phi_1
    slope[3:, 3:] = phi_2.T @ phi_2
    slope[3:, 2] = -phi_2.T @ current
    scale = np.sqrt(np.abs(np.diag(slope)))
    scale[scale == 0] = 1.0
    inverse: Float = np.linalg.pinv(slope / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse


def estimate_attenuation_bias(
    electrical: Float, mechanical: Float, theta: Float, impulse: Float, slope: Float, noise: Float
) -> Float:
    """Return the bias (6,) of [L, R, K, Jt, ft, Cd] due to noise on the regressors, to first order.

    ``impulse``, ``slope`` and ``noise`` (3,) are those of the residual autocovariances. The paper's method does not
    correct this bias, so its interval must include it.
    """
    rows = electrical.shape[0]
    ff, dd, df = (float(a @ b) * rows for a, b in ((impulse, impulse), (slope, slope), (slope, impulse)))
    pull = np.zeros((6, 6))
    pull[:2, :2] = noise[1] * np.array([[dd, df], [df, ff]])
    pull[2, 2] = noise[2] * ff
    pull[3:5, 3:5] = noise[2] * np.array([[dd, df], [df, ff]])
    return -_invert_normal_equations(electrical[:, 1:], mechanical[:, 1:], mechanical[:, 0]) @ pull @ theta
