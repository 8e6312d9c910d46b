"""Solves linear least squares by scaled normal equations: small, fast, on one thread.

An orthogonal factorisation of some thousand samples would cost ten times more, and a library's own threads would
disturb the bus's receive thread. At six columns a library call is mostly overhead, so the small matrix is diagonalised
here.
"""

import numpy as np

from fdhil.model import compile_kernel
from fdhil.records import Float

NIL = 1e-15  # of the largest power: below it a direction is rounding
ROUNDING = 1e-16  # of two powers: below it no rotation is needed
SWEEPS = 30  # of Jacobi rotations: six suffice for any matrix of this size


def solve_least_squares(phi: Float, y: Float) -> tuple[Float, float]:
    """Return the least-squares solution (k,) of phi theta = y ([DES] eq. 3) and the condition number of scaled phi."""
    inverse, condition = invert_gram(phi)
    return inverse @ (phi.T @ y), condition


def invert_gram(phi: Float) -> tuple[Float, float]:
    """Return the (pseudo-)inverse (k, k) of phi' phi, and the condition number of phi with columns of equal length."""
    return invert_symmetric(phi.T @ phi)


def invert_symmetric(gram: Float) -> tuple[Float, float]:
    """Return the (pseudo-)inverse (k, k) of a Gram matrix, and the condition number of its scaled root.

    NaN and an infinite condition number where the matrix is not finite.
    """
    inverse, condition = _compute_inverse(gram)
    return inverse, float(condition)


def compute_inverse_root(information: Float) -> Float:
    """Return a root (k, r) of the (pseudo-)inverse of ``information`` (k, k): root root' is that inverse."""
    root, _, _ = _factorise_inverse(information)
    return root


@compile_kernel
def _diagonalise_jacobi(matrix: Float) -> tuple[Float, Float]:
    """Return eigenvalues (k,) and eigenvectors (k, k) of a symmetric matrix by Jacobi rotations."""
    a = matrix.copy()
    k = a.shape[0]
    axes = np.eye(k)
    for _ in range(SWEEPS):
        turned = False
        for p in range(k):
            for q in range(p + 1, k):
                if abs(a[p, q]) <= ROUNDING * np.sqrt(abs(a[p, p] * a[q, q])):
                    continue
                turned = True
                half = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(half) + np.sqrt(half * half + 1.0))
                t = t if half >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for j in range(k):
                    a[p, j], a[q, j] = c * a[p, j] - s * a[q, j], s * a[p, j] + c * a[q, j]
                for j in range(k):
                    a[j, p], a[j, q] = c * a[j, p] - s * a[j, q], s * a[j, p] + c * a[j, q]
                    axes[j, p], axes[j, q] = c * axes[j, p] - s * axes[j, q], s * axes[j, p] + c * axes[j, q]
        if not turned:
            break
    return np.diag(a).copy(), axes


@compile_kernel
def _factorise_inverse(gram: Float) -> tuple[Float, float, bool]:
    """Return a root (k, r) of the inverse, the condition number, and whether all is finite.

    The matrix is scaled to a unit diagonal first; directions without power are left out.
    """
    k = gram.shape[0]
    scale = np.empty(k)
    for a in range(k):
        scale[a] = np.sqrt(abs(gram[a, a]))
        if scale[a] == 0.0:
            scale[a] = 1.0
    scaled = np.empty((k, k))
    for a in range(k):
        for b in range(k):
            scaled[a, b] = (gram[a, b] + gram[b, a]) / 2.0 / (scale[a] * scale[b])
            if not np.isfinite(scaled[a, b]):
                return np.full((k, k), np.nan), np.inf, False
    powers, axes = _diagonalise_jacobi(scaled)
    least, most = powers.min(), powers.max()
    root = np.empty((k, k))
    kept = 0
    for q in range(k):
        if powers[q] > most * NIL:
            root[:, kept] = axes[:, q] / scale / np.sqrt(powers[q])
            kept += 1
    condition = np.sqrt(most / least) if kept == k and least > 0.0 else np.inf
    return root[:, :kept], condition, True


@compile_kernel
def _compute_inverse(gram: Float) -> tuple[Float, float]:
    root, condition, _ = _factorise_inverse(gram)
    k = gram.shape[0]
    inverse = np.zeros((k, k))
    for a in range(k):
        for b in range(k):
            for q in range(root.shape[1]):
                inverse[a, b] += root[a, q] * root[b, q]
    return inverse, condition
