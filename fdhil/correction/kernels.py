"""The compiled projection onto what an offset may do."""

from __future__ import annotations

import numpy as np

from fdhil.model.compiled import compiled
from fdhil.records import Float

ITERATIONS = 60


@compiled
def _differences(o: Float, start: Float, which: int) -> Float:
    """Return o (0), its first (1) or its second (2) difference, each (n,); ``start`` = [o before, o before that]."""
    n = o.size
    out = np.empty(n)
    for k in range(n):
        one = o[k - 1] if k >= 1 else start[0]
        two = o[k - 2] if k >= 2 else (start[0] if k == 1 else start[1])
        if which == 0:
            out[k] = o[k]
        elif which == 1:
            out[k] = o[k] - one
        else:
            out[k] = o[k] - 2.0 * one + two
    return out


@compiled
def _scatter(force: Float, which: int, into: Float) -> None:
    """Add the transposed difference of ``force`` (n,) to ``into`` (n,)."""
    n = force.size
    for k in range(n):
        if which == 0:
            into[k] += force[k]
        elif which == 1:
            into[k] += force[k] - (force[k + 1] if k + 1 < n else 0.0)
        else:
            one = force[k + 1] if k + 1 < n else 0.0
            two = force[k + 2] if k + 2 < n else 0.0
            into[k] += force[k] - 2.0 * one + two


@compiled
def _solve(d0: Float, d1: Float, d2: Float, b: Float) -> Float:
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


@compiled
def _weigh(weight: Float, which: int, d0: Float, d1: Float, d2: Float) -> None:
    """Add C' diag(weight) C of a difference to the three diagonals."""
    n = weight.size
    for k in range(n):
        g = weight[k]
        if which == 0:
            d0[k] += g
        elif which == 1:
            d0[k] += g
            if k >= 1:
                d0[k - 1] += g
                d1[k - 1] -= g
        else:
            d0[k] += g
            if k >= 1:
                d0[k - 1] += 4.0 * g
                d1[k - 1] -= 2.0 * g
            if k >= 2:
                d0[k - 2] += g
                d1[k - 2] -= 2.0 * g
                d2[k - 2] += g


@compiled
def _all_differences(o: Float, start: Float, into: Float) -> None:
    """Write o and its first two differences into the three rows of ``into`` (3, n)."""
    for c in range(3):
        into[c] = _differences(o, start, c)


@compiled
def _begin(value: Float, limits: Float, mu: float, slack: Float, force: Float) -> None:
    """Set slacks (6, n) well inside the limits and the forces that belong to them; row 2 c + side is one bound."""
    for bound in range(6):
        c, sign = bound // 2, 1.0 - 2.0 * (bound % 2)
        for k in range(value.shape[1]):
            slack[bound, k] = max(limits[c] - sign * value[c, k], 0.1 * limits[c])
            force[bound, k] = mu / slack[bound, k]


@compiled
def _newton(
    value: Float, slack: Float, force: Float, limits: Float, mu: float, b: Float, diagonals: Float
) -> tuple[float, float]:
    """Add the bounds to the system (``b`` (n,), ``diagonals`` (3, n)); return the mean gap and the worst miss."""
    n = b.size
    weight, push = np.empty(n), np.empty(n)
    gap = 0.0
    miss = 0.0
    for c in range(3):
        for k in range(n):
            s1, s2 = slack[2 * c, k], slack[2 * c + 1, k]
            l1, l2 = force[2 * c, k], force[2 * c + 1, k]
            r1 = s1 + value[c, k] - limits[c]
            r2 = s2 - value[c, k] - limits[c]
            gap += l1 * s1 + l2 * s2
            miss = max(miss, abs(r1) / limits[c], abs(r2) / limits[c])
            weight[k] = l1 / s1 + l2 / s2
            # with the forces of this iterate the two -l cancel those in the gradient
            push[k] = -(mu + l1 * r1) / s1 + (mu + l2 * r2) / s2
        _scatter(push, c, b)
        _weigh(weight, c, diagonals[0], diagonals[1], diagonals[2])
    return gap / (6 * n), miss


@compiled
def _direction(s: float, f: float, value: float, step: float, limit: float, mu: float) -> tuple[float, float]:
    """Return how slack and force of one bound move with the step; ``value`` and ``step`` carry the bound's sign."""
    ds = limit - value - s - step
    return ds, (mu - f * ds) / s - f


@compiled
def _lengths(value: Float, step: Float, slack: Float, force: Float, limits: Float, mu: float) -> tuple[float, float]:
    """Return how much of the step may be taken, so that every slack and every force stays positive."""
    primal = 1.0
    dual = 1.0
    for bound in range(6):
        c, sign = bound // 2, 1.0 - 2.0 * (bound % 2)
        for k in range(value.shape[1]):
            s, f = slack[bound, k], force[bound, k]
            ds, df = _direction(s, f, sign * value[c, k], sign * step[c, k], limits[c], mu)
            if ds < 0.0:
                primal = min(primal, -0.99 * s / ds)
            if df < 0.0:
                dual = min(dual, -0.99 * f / df)
    return primal, dual


@compiled
def _advance(
    value: Float, step: Float, slack: Float, force: Float, limits: Float, mu: float, primal: float, dual: float
) -> float:
    """Move slacks and forces by their shares of the step; return the mean gap that is left."""
    total = 0.0
    for bound in range(6):
        c, sign = bound // 2, 1.0 - 2.0 * (bound % 2)
        for k in range(value.shape[1]):
            s, f = slack[bound, k], force[bound, k]
            ds, df = _direction(s, f, sign * value[c, k], sign * step[c, k], limits[c], mu)
            slack[bound, k] = s + primal * ds
            force[bound, k] = f + dual * df
            total += slack[bound, k] * force[bound, k]
    return float(total / (6 * value.shape[1]))


@compiled
def project(wanted: Float, limits: Float, start: Float) -> Float:
    """Return the nearest (n,) to ``wanted`` (least squares) whose value, first and second difference stay in +-limits.

    A primal-dual interior-point method; each of its steps is one pentadiagonal system. ``limits`` (3,) > 0.
    """
    n = wanted.size
    o = np.zeros(n)
    zero = np.zeros(2)
    value, step, diagonals = np.empty((3, n)), np.empty((3, n)), np.empty((3, n))
    slack, force = np.empty((6, n)), np.empty((6, n))
    scale = max(1.0, np.abs(wanted).max())
    mu = 0.1 * scale
    _all_differences(o, start, value)
    _begin(value, limits, mu, slack, force)
    for _ in range(ITERATIONS):
        b = wanted - o
        diagonals[0] = 1.0
        diagonals[1:] = 0.0
        gap, miss = _newton(value, slack, force, limits, mu, b, diagonals)
        if gap < 1e-7 * scale and miss < 1e-9:
            break
        move = _solve(diagonals[0], diagonals[1], diagonals[2], b)
        _all_differences(move, zero, step)
        primal, dual = _lengths(value, step, slack, force, limits, mu)
        left = _advance(value, step, slack, force, limits, mu, primal, dual)
        o += primal * move
        _all_differences(o, start, value)
        mu = (0.1 if min(primal, dual) > 0.9 else 0.3) * left
    return o


@compiled
def extent(offset: Float, start: Float, acceleration: float, window: int) -> tuple[float, ...]:
    """Return the largest |value|, |first| and |second difference|, reach if it brakes, travel within ``window`` rows.

    ``start`` = [o before, o before that]; the travel before the first row counts as none.
    """
    highest, fastest, hardest, farthest, longest = 0.0, 0.0, 0.0, 0.0, 0.0
    one, two = start[0], start[1]
    travel = 0.0
    past = np.zeros(window)  # of the last rows, what each travelled
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


@compiled
def rounded(exact: Float, settled: int, uneven: float) -> Float:
    """Round (n,) with the error carried on; from row ``settled`` on change the increment as seldom as it can be.

    Rows 0 and 1 are rounded alone. ``uneven``: rounding error (increments times rows) that ends an increment's turn.
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
