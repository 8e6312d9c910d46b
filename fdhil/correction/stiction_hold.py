"""Keeps a resting axis at rest: while dry friction holds the table an offset changes the regulators alone.

Without it, their integrals wind up on the remaining error until the table slips by micrometres, now and then. While it
is held the regulators alone are a linear system, whatever their structure: two simulated responses show which offset
leads the current to the middle of the dry friction's band, and which one, by asking for no motion, keeps it there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg.lapack import dposv

from fdhil.config import Axis
from fdhil.correction import offset_kernels
from fdhil.correction.linear_loop import remove_limits
from fdhil.model import (
    CURRENT_DEMAND,
    POSITION,
    TABLE,
    Commands,
    PreparedDrive,
    Response,
    State,
    create_zero_state,
    has_spring,
    prepare_drive,
    rad_per_mm,
)
from fdhil.prediction import FrictionBand, compute_friction_band
from fdhil.records import Float, Parameters

FREE_S = 0.3  # in which the current is brought to its target
WATCHED_S = 0.06  # after it, in which the current must have settled
STEADINESS = 3.0  # A per increment/cycle^2: weight of the offset's smoothness against the current
AGAIN_S = 0.4
UNEVEN = 20.0  # increments times cycles of rounding error after which the other neighbour is used
PASSES = 3
LENGTHS_KEPT = 8  # of rests: most recur in each iteration
KNOT_ROWS = 8
EVERY = 3  # every n-th cycle suffices: the current cannot change faster than the spline
RIDGE = 1e-6  # for splines of which only the tail lies within a short rest
HELD_NM = 1e9


class StictionHold:
    """Holds one axis at rest; quantities that depend on its drive alone are computed once."""

    def __init__(self, parameters: Parameters, axis: Axis, sync_period_s: float, increment_mm: float) -> None:
        self._held = prepare_drive(*remove_limits(parameters, axis, HELD_NM), sync_period_s)
        self._parameters, self._rad_per_mm = parameters, rad_per_mm(axis)
        self._place = TABLE if has_spring(parameters) else POSITION
        self._period_s, self._increment_mm = sync_period_s, increment_mm
        self._free, self._again = round(FREE_S / sync_period_s), round(AGAIN_S / sync_period_s)
        impulse = np.zeros(round((FREE_S + WATCHED_S) / sync_period_s))
        impulse[2] = increment_mm
        self._answer_a = _get_current_demand(self._held.run(Commands(impulse), create_zero_state(0.0)))
        self._lead = _CurrentLead(self._answer_a, self._free)

    def compute_band_at(self, position_mm: float) -> FrictionBand:
        """Return the torques that hold the table at a position."""
        return compute_friction_band(self._parameters, position_mm * self._rad_per_mm)

    def compute_hold_offset(self, reference_mm: Float, fixed: Float, state: State) -> Float:
        """Return the offset (n,) in whole increments for a rest (n,) of ``reference_mm`` that begins in ``state``.

        ``fixed`` (2,): the offsets of its first two rows, which are already used.
        """
        stands_mm = float(state[self._place])
        silent = (stands_mm - float(reference_mm[0])) / self._increment_mm
        middle_a = self.compute_band_at(stands_mm).middle / self._parameters.K
        offset = np.full(reference_mm.size, silent)
        offset[:2] = fixed
        for first in range(0, reference_mm.size - 2, self._again):  # the effect of rounding is compensated as well
            rest = reference_mm[first:]
            exact = np.full(rest.size, silent)
            exact[:2] = offset[first : first + 2]
            rows = min(self._answer_a.size, rest.size)
            free = min(rows - 2, self._free)
            base_a = _get_current_demand(self._simulate_held(rest, exact, state, rows))
            exact[2 : 2 + free] += self._lead.solve_lead_away(base_a - middle_a, exact[:2] - silent)
            offset[first:] = offset_kernels.round_with_carry(exact, 2 + free, UNEVEN)
            state = self._simulate_held(rest, offset[first:], state, min(self._again, rest.size)).end
        return offset

    def _simulate_held(self, rest_mm: Float, offset: Float, state: State, rows: int) -> Response:
        return run_with_offset(self._held, rest_mm, offset, self._increment_mm, state, rows)


def run_with_offset(
    drive: PreparedDrive, reference_mm: Float, offset: Float, increment_mm: float, state: State, rows: int
) -> Response:
    """Simulate a drive's next ``rows`` cycles with an offset in increments; both paths begin with the first of them."""
    ahead = min(rows + 2, reference_mm.size)  # a cycle depends on two further rows
    return drive.run(Commands(reference_mm[:ahead] + offset[:ahead] * increment_mm), state, 0, rows)


def _get_current_demand(response: Response) -> Float:
    """Return the current demand (n,) at the end of each cycle."""
    return np.append(response.states[CURRENT_DEMAND, 1:], response.end[CURRENT_DEMAND])


@dataclass(frozen=True, slots=True)
class _RestSplines:
    """The splines within a rest of some length, their stiffness, and both as one matrix."""

    effect: Float
    even: Float
    spline: Float
    bend_first: Float
    bend_second: Float
    stiffness: Float


class _CurrentLead:
    """The response to an offset d from row 2 on, as a cubic spline of knots ``step`` rows apart.

    ``spline`` (free + step, m) is the basis of d, ``bends`` its second differences, ``effect`` (n, m) the current, A,
    that each of them causes. A rest of less than n rows uses their first rows.
    """

    def __init__(self, answer_a: Float, free: int) -> None:
        """Prepare for rests of any length; ``answer_a`` (n,) is the response to an offset of 1 in row 2."""
        pieces = max(1, round(free / KNOT_ROWS))
        self._free, self._step = free, free / pieces
        knots = np.arange(-3, pieces + 5) * self._step
        self._spline = np.asarray(BSpline.design_matrix(np.arange(0.0, free + self._step), knots, 3).toarray())
        size = 2 * max(answer_a.size, len(self._spline))
        spectrum = np.fft.rfft(answer_a, size)[:, None] * np.fft.rfft(self._spline, size, axis=0)
        self._effect = np.ascontiguousarray(np.fft.irfft(spectrum, size, axis=0)[: answer_a.size])
        self._bends = np.diff(np.pad(self._spline, ((2, 0), (0, 0))), 2, axis=0)
        self._smooth = (STEADINESS**2 / EVERY) * self._bends.T
        self._stiffness = self._smooth @ self._bends
        self._length = lru_cache(maxsize=LENGTHS_KEPT)(self._prepare_length)

    def _prepare_length(self, n: int) -> _RestSplines:
        free = min(n - 2, self._free)
        goes_on = n > free + 2
        columns = round(self._free / self._step) if goes_on else int(np.ceil(free / self._step)) + 3
        seen = n if goes_on else n - 2  # the last cycles of a rest depend on rows after it
        rows = free + 2 if goes_on else free
        # of these columns only the last few have bends beyond these rows
        behind = slice(rows, rows + round(4 * self._step) + 2)
        stiffness = self._stiffness[:columns, :columns] - (
            self._smooth[:columns, behind] @ self._bends[behind, :columns]
        )
        stiffness[np.diag_indices(columns)] += RIDGE
        first, second = self._smooth[:columns, 0], self._smooth[:columns, 1]
        effect = np.ascontiguousarray(self._effect[:seen:EVERY, :columns])
        even = effect.T @ effect + stiffness
        return _RestSplines(
            effect, even, self._spline[:free, :columns], first, second if rows > 1 else 0 * second, stiffness
        )

    def solve_lead_away(self, base_a: Float, before: Float) -> Float:
        """Return d (free,): least squares of the current base (n,) + effect and of d's bends.

        d ends in 0 with its slope, unless the rest ends first. ``before`` (2,) are its values in rows 0 and 1.
        """
        length = self._length(base_a.size)
        effect = length.effect
        base_a = base_a[: EVERY * len(effect) : EVERY]
        bent = length.bend_first * (before[0] - 2 * before[1]) + length.bend_second * before[1]
        found = dposv(length.even, -(effect.T @ base_a) - bent)[1]
        for _ in range(PASSES - 1):  # the largest currents have the largest weight: they break the table loose
            weighted = effect.T * (1.0 + (base_a + effect @ found) ** 2)
            found = dposv(weighted @ effect + length.stiffness, -(weighted @ base_a) - bent)[1]
        return np.asarray(length.spline @ found)
