"""What an offset does while dry friction holds the table: nothing, but to the regulators.

Left alone, their integrals wind up on the remaining error until the table slips by micrometres, now and then. While
it is held the regulators alone are a linear system, whatever their structure: two simulated answers tell which offset
leads the current to the middle of the dry friction's band, and which one, by asking for no motion, keeps it there.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.interpolate import BSpline

from fdhil.config import Axis
from fdhil.model import closed_loop
from fdhil.model.closed_loop import Response, State
from fdhil.model.kernels import CURRENT_DEMAND, POSITION
from fdhil.records import Float, Parameters

FREE_S = 0.3  # in which the current is led away
WATCHED_S = 0.06  # behind it, in which the current must have come to rest
STEADINESS = 3.0  # A per increment a cycle^2: how smooth the offset is to be, against how small the current
AGAIN_S = 0.4
UNEVEN = 20.0  # increments times cycles of rounding error after which the other neighbour is taken
PASSES = 4
KNOT_ROWS = 8
HELD_NM = 1e9


def quiet(
    parameters: Parameters,
    axis: Axis,
    sync_period_s: float,
    reference_mm: Float,
    increment_mm: float,
    fixed: Float,
    state: State,
) -> Float:
    """Return the offset (n,) in whole increments for a rest (n,) of ``reference_mm`` that begins in ``state``.

    ``fixed`` (2,): the offsets of its first two rows, which are already used.
    """
    held = _held(parameters, axis)
    silent = float(state[POSITION] - reference_mm[0]) / increment_mm
    offset = np.full(reference_mm.size, silent)
    offset[:2] = fixed
    again = round(AGAIN_S / sync_period_s)
    impulse = np.zeros(round((FREE_S + WATCHED_S) / sync_period_s))
    impulse[2] = increment_mm
    answer = _demand(closed_loop.simulate(*held, sync_period_s, impulse))
    for first in range(0, reference_mm.size - 2, again):  # what rounding left in the integrals is led away as well
        rest = reference_mm[first:]
        rows = min(answer.size, rest.size)
        exact = np.full(rest.size, silent)
        exact[:2] = offset[first : first + 2]
        base = _demand(closed_loop.simulate(*held, sync_period_s, rest + exact * increment_mm, state=state, rows=rows))
        free = min(rows - 2, round(FREE_S / sync_period_s))
        exact[2 : 2 + free] += _lead_away(base, answer[:rows], exact[:2] - silent, free)
        offset[first:] = _rounded(exact, 2 + free)
        rows = min(again, rest.size)
        commanded = rest + offset[first:] * increment_mm
        state = closed_loop.simulate(*held, sync_period_s, commanded, state=state, rows=rows).end
    return offset


def _held(parameters: Parameters, axis: Axis) -> tuple[Parameters, Axis]:
    """The same drive with a table that nothing moves, and without limits."""
    wide = axis.regulators.model_copy(update={"current_limit_a": 1e9, "voltage_limit_v": 1e9})
    return replace(parameters, Cd=HELD_NM), axis.model_copy(update={"regulators": wide})


def _demand(response: Response) -> Float:
    """Return the current demand (n,) at the end of each cycle."""
    return np.append(response.states[CURRENT_DEMAND, 1:], response.end[CURRENT_DEMAND])


def _lead_away(base_a: Float, answer_a: Float, before: Float, free: int) -> Float:
    """Return d (free,), increments from row 2 on: least squares of the current base + answer * d and of d's bends.

    d is a cubic spline that ends in 0 unless the rest ends first; ``before`` (2,) are its values in rows 0 and 1.
    """
    goes_on = base_a.size > free + 2
    spline = _spline(free, goes_on)
    effect = np.column_stack([np.convolve(answer_a, column)[: base_a.size] for column in spline.T])
    bends = np.diff(np.pad(spline, ((2, 2 if goes_on else 0), (0, 0))), 2, axis=0)
    known = np.zeros(len(bends))
    known[:2] = before[0] - 2 * before[1], before[1]
    smooth = STEADINESS**2 * bends.T
    counts = np.ones(base_a.size)
    if not goes_on:
        counts[-2:] = 0.0  # these cycles look at rows behind the rest
    weight = counts
    found = np.zeros(spline.shape[1])
    for _ in range(PASSES):  # the largest currents weigh most: it is they that break the table loose
        left = (effect.T * weight) @ effect + smooth @ bends
        found = np.linalg.solve(left, -(effect.T @ (weight * base_a)) - smooth @ known)
        weight = counts * (1.0 + (base_a + effect @ found) ** 2)
    return np.asarray(spline @ found)


@lru_cache(maxsize=64)
def _spline(rows: int, to_zero: bool) -> Float:
    """Return (rows, m) cubic basis splines on even knots; ``to_zero``: those that are 0 with their slope at the end."""
    pieces = max(1, round(rows / KNOT_ROWS))
    step = rows / pieces
    knots = np.arange(-3, pieces + 1) * step
    values: Float = BSpline.design_matrix(
        np.arange(rows) + 0.0, np.append(knots, knots[-1] + step * np.arange(1, 4)), 3
    ).toarray()
    return values[:, :pieces] if to_zero else values


def _rounded(exact: Float, settled: int) -> Float:
    """Round (n,) with the error carried on; from row ``settled`` on change the increment as seldom as it can be."""
    out = np.rint(exact)
    carried = 0.0
    for k in range(2, min(settled, exact.size)):
        out[k] = np.rint(exact[k] + carried)
        carried += exact[k] - out[k]
    if settled >= exact.size:
        return out
    low, share = np.floor(exact[settled]), exact[settled] % 1.0
    high = share >= 0.5
    for k in range(settled, exact.size):
        out[k] = low + high
        carried += share - high
        if abs(carried) > UNEVEN:
            high = carried > 0
    return out
