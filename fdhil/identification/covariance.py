"""Covariances that stay honest when residuals are coloured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdhil.records import Float


def long_run(scores: Float, lengths: Sequence[int], lags: int) -> Float:
    """Return the long-run covariance sum (k, k) of ``scores`` (m, k), windows of ``lengths`` stacked (Parzen)."""
    total = np.zeros((scores.shape[1], scores.shape[1]))
    start = 0
    for length in lengths:
        s = scores[start : start + length]
        start += length
        total += s.T @ s
        for lag in range(1, min(lags, length - 1) + 1):
            x = lag / (lags + 1)
            weight = 1 - 6 * x * x + 6 * x**3 if x <= 0.5 else 2 * (1 - x) ** 3
            cross = s[lag:].T @ s[:-lag]
            total += weight * (cross + cross.T)
    return total


def sandwich(
    electrical: Float, mechanical: Float, residual_u: Float, residual_t: Float, lengths: Sequence[int], lags: int
) -> Float:
    """Return the covariance (6, 6) of [L, R, K, Jt, ft, Cd] fitted in two steps.

    ``electrical`` (m, 4) is [u, Di, i, w], ``mechanical`` (m, 4) is [i, Dw, w, sign w]; the second step uses K of the
    first, so the scores of both are stacked, and their coloured residuals summed over ``lags``.
    """
    phi_1, phi_2 = electrical[:, 1:], mechanical[:, 1:]
    scores = np.column_stack([phi_1 * residual_u[:, None], phi_2 * residual_t[:, None]])
    slope = np.zeros((6, 6))
    slope[:3, :3] = phi_1.T @ phi_1
    slope[3:, 3:] = phi_2.T @ phi_2
    slope[3:, 2] = -phi_2.T @ mechanical[:, 0]
    scale = np.sqrt(np.abs(np.diag(slope)))
    scale[scale == 0] = 1.0
    bread = np.linalg.pinv(slope / np.outer(scale, scale))
    freedom = phi_1.shape[0] / max(1.0, phi_1.shape[0] - 3.0 * lags)
    meat = long_run(scores / scale, lengths, lags) * freedom
    covariance: Float = bread @ meat @ bread.T / np.outer(scale, scale)
    return covariance
