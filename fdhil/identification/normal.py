"""Linear least squares by scaled normal equations: small, fast, and on one thread.

The regressions here have a handful of well-scaled columns and thousands of rows; an orthogonal factorisation would
cost ten times more and, in a library with its own threads, disturb the bus's receive thread.
"""

from __future__ import annotations

import numpy as np

from fdhil.records import Float


def solve(phi: Float, y: Float) -> tuple[Float, float]:
    """Return the least-squares solution (k,) of phi theta = y ([DES] eq. 3) and the condition number of scaled phi."""
    inverse, condition = inverse_gram(phi)
    return inverse @ (phi.T @ y), condition


def inverse_gram(phi: Float) -> tuple[Float, float]:
    """Return the (pseudo-)inverse (k, k) of phi' phi, and the condition number of phi with columns of equal length."""
    return inverse_of(phi.T @ phi)


def inverse_of(gram: Float) -> tuple[Float, float]:
    """Return the (pseudo-)inverse (k, k) of a Gram matrix, and the condition number of its scaled root."""
    scale = np.sqrt(np.abs(np.diag(gram)))
    scale[scale == 0] = 1.0
    scaled = gram / np.outer(scale, scale)
    if not np.isfinite(scaled).all():
        return np.full_like(gram, np.nan), np.inf
    powers, axes = np.linalg.eigh((scaled + scaled.T) / 2)
    kept = powers > powers[-1] * 1e-15
    condition = float(np.sqrt(powers[-1] / powers[0])) if kept.all() and powers[0] > 0 else np.inf
    inverse: Float = (axes[:, kept] / powers[kept]) @ axes[:, kept].T / np.outer(scale, scale)
    return inverse, condition
