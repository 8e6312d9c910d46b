"""Compiled kernels that project an offset onto its limits, measure it and round it."""

from __future__ import annotations

import numpy as np

from fdhil.model import compile_kernel
from fdhil.records import Float

ITERATIONS = 60


# an offset, its first and its second difference, as weights on a row and the rows before it
DIFFERENCES = np.array([[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, -2.0, 1.0]])


@compile_kernel
def _compute_differences(o: Float, start: Float, into: Float) -> None:
    """Write o and its differences into the rows of ``into`` (3, n); ``start`` = [o before, o before that]."""
    for k in range(o.size):
        one = o[k - 1] if k >= 1 else start[0]
        two = o[k - 2] if k >= 2 else start[1 - k]
        into[0, k] = o[k]
        into[1, k] = o[k] - one
        into[2, k] = o[k] - 2.0 * one + two


@compile_kernel
def _add_bound(force: Float, weight: Float, which: int, b: Float, diagonals: Float) -> None:
    """Add to the system C' ``force`` (n,) and C' diag(``weight``) C, with C the difference ``which``."""
    own = DIFFERENCES[which]
    n = b.size
    for k in range(n):
        total = force[k]
        for j in range(1, min(which + 1, n - k)):
            total += own[j] * force[k + j]
        b[k] += total
        for i in range(min(which, k) + 1):
            for j in range(i, min(which, k) + 1):
                diagonals[j - i, k - j] += own[i] * own[j] * weight[k]


@compile_kernel
def _solve_pentadiagonal(d0: Float, d1: Float, d2: Float, b: Float) -> Float:
    """Solve a symmetric positive pentadiagonal system in place; d1[k], d2[k] couple row k to k + 1 and k + 2."""
    n = b.size
    for k in range(n):
        pivot = d0[k]
        if k + 1 < n:
            low = d1[k] / pivot
            d0[k + 1] -= low * d1[k]
            b[k + 1] -= low * b[k]
            if k + 2 < n:
                d1[k + 1] -= low * d2[k]
        if k + 2 < n:
            low = d2[k] / pivot
            d0[k + 2] -= low * d2[k]
            b[k + 2] -= low * b[k]
    x = np.empty(n)
    for k in range(n - 1, -1, -1):
        rest = b[k]
        if k + 1 < n:
            rest -= d1[k] * x[k + 1]
        if k + 2 < n:
            rest -= d2[k] * x[k + 2]
        x[k] = rest / d0[k]
    return x


@compile_kernel
def _add_bounds(
    value: Float, slack: Float, force: Float, limits: Float, mu: float, b: Float, diagonals: Float
) -> float:
    """Add the bounds to the system (``b`` (n,), ``diagonals`` (3, n)); return by how much the worst one misses."""
    n = b.size
    weight, push = np.empty(n), np.empty(n)
    miss = 0.0
    for c in range(3):
        for k in range(n):
            s1, s2 = slack[2 * c, k], slack[2 * c + 1, k]
            l1, l2 = force[2 * c, k], force[2 * c + 1, k]
            r1 = s1 + value[c, k] - limits[c]
            r2 = s2 - value[c, k] - limits[c]
            miss = max(miss, abs(r1) / limits[c], abs(r2) / limits[c])
            weight[k] = l1 / s1 + l2 / s2
            # with the forces of this iterate the two -l cancel those in the gradient
            push[k] = -(mu + l1 * r1) / s1 + (mu + l2 * r2) / s2
        _add_bound(push, weight, c, b, diagonals)
    return miss


@compile_kernel
def _advance_slacks(
    value: Float, step: Float, slack: Float, force: Float, limits: Float, mu: float
) -> tuple[float, float]:
    """Move slacks and forces with the step, as far as each stays positive; return both shares of it."""
    n = value.shape[1]
    by = np.empty((2, 6, n))
    share = np.ones(2)
    for bound in range(6):
        c, sign = bound // 2, 1.0 - 2.0 * (bound % 2)
        for k in range(n):
            s, f = slack[bound, k], force[bound, k]
            ds = limits[c] - sign * value[c, k] - s - sign * step[c, k]
            df = (mu - f * ds) / s - f
            by[0, bound, k], by[1, bound, k] = ds, df
            if ds < 0.0:
                share[0] = min(share[0], -0.99 * s / ds)
            if df < 0.0:
                share[1] = min(share[1], -0.99 * f / df)
    slack += share[0] * by[0]
    force += share[1] * by[1]
    return share[0], share[1]


@compile_kernel
def project_onto_limits(wanted: Float, limits: Float, start: Float) -> Float:
    """Return the nearest (n,) to ``wanted`` (least squares) whose value, first and second difference stay in +-limits.

    A primal-dual interior-point method; each of its steps is one pentadiagonal system. ``limits`` (3,) > 0. Row 2 c of
    slacks and forces is the upper bound of difference c, row 2 c + 1 the lower one.
    """
    n = wanted.size
    o = np.zeros(n)
    value, step, diagonals = np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
    slack = np.empty((6, n))
    scale = max(1.0, np.abs(wanted).max())
    mu = 0.1 * scale
    _compute_differences(o, start, value)
    for c in range(3):
        slack[2 * c] = np.maximum(limits[c] - value[c], 0.1 * limits[c])
        slack[2 * c + 1] = np.maximum(limits[c] + value[c], 0.1 * limits[c])
    force = mu / slack
    gap = mu  # the mean product of a slack and its force
    for _ in range(ITERATIONS):
        b = wanted - o
        diagonals[0] = 1.0
        diagonals[1:] = 0.0
        miss = _add_bounds(value, slack, force, limits, mu, b, diagonals)
        if gap < 1e-7 * scale and miss < 1e-9:
            break
        move = _solve_pentadiagonal(diagonals[0], diagonals[1], diagonals[2], b)
        _compute_differences(move, np.zeros(2), step)
        primal, dual = _advance_slacks(value, step, slack, force, limits, mu)
        o += primal * move
        _compute_differences(o, start, value)
        gap = (slack * force).sum() / (6 * n)
        mu = (0.1 if min(primal, dual) > 0.9 else 0.3) * gap
    return o


@compile_kernel
def measure_extent(offset: Float, start: Float, acceleration: float, window: int) -> tuple[float, ...]:
    """Return the largest |value|, |first| and |second difference|, reach if it brakes, travel within ``window`` rows.

    ``start`` = [o before, o before that]; the travel before the first row counts as none.
    """
    highest, fastest, hardest, farthest, longest = 0.0, 0.0, 0.0, 0.0, 0.0
    one, two = start[0], start[1]
    travel = 0.0
    past = np.zeros(window)  # travel of each of the last rows
    for k in range(offset.size):
        rate = offset[k] - one
        highest, fastest = max(highest, abs(offset[k])), max(fastest, abs(rate))
        hardest = max(hardest, abs(rate - (one - two)))
        outward = max(rate * np.sign(offset[k]), 0.0)
        farthest = max(farthest, abs(offset[k]) + outward * outward / (2.0 * acceleration))
        travel += abs(rate) - past[k % window]
        past[k % window] = abs(rate)
        longest = max(longest, travel)
        two, one = one, offset[k]
    return highest, fastest, hardest, farthest, longest


@compile_kernel
def round_with_carry(exact: Float, settled: int, uneven: float) -> Float:
    """Round (n,) with the error carried on; from row ``settled`` on change the increment as rarely as possible.

    Rows 0 and 1 are rounded alone. ``uneven``: rounding error (increments times rows) after which the increment
    changes.
    """
    out = np.rint(exact)
    carried = 0.0
    for k in range(2, min(settled, exact.size)):
        out[k] = np.rint(exact[k] + carried)
        carried += exact[k] - out[k]
    if settled >= exact.size:
        return out
    low = np.floor(exact[settled])
    share = exact[settled] - low
    high = 1.0 if share >= 0.5 else 0.0
    for k in range(settled, exact.size):
        out[k] = low + high
        carried += share - high
        if abs(carried) > uneven:
            high = 1.0 if carried > 0.0 else 0.0
    return out
