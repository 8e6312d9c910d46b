"""What an offset does while dry friction holds the table: nothing, but to the regulators.

Left alone, their integrals wind up on the remaining error until the table slips by micrometres, now and then. While
it is held the regulators alone are a linear system, whatever their structure: two simulated answers tell which offset
leads the current to the middle of the dry friction's band, and which one, by asking for no motion, keeps it there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg.lapack import dposv

from fdhil.config import Axis
from fdhil.correction import kernels
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
EVERY = 3  # of the cycles says enough: the current cannot change faster than the spline
RIDGE = 1e-6  # for splines that lie behind a short rest but for their tail
HELD_NM = 1e9


class Resting:
    """The rests of one axis: what depends on its drive alone is found once."""

    def __init__(self, parameters: Parameters, axis: Axis, sync_period_s: float, increment_mm: float) -> None:
        self._held = _held(parameters, axis)
        self._period_s, self._increment_mm = sync_period_s, increment_mm
        self._free, self._again = round(FREE_S / sync_period_s), round(AGAIN_S / sync_period_s)
        impulse = np.zeros(round((FREE_S + WATCHED_S) / sync_period_s))
        impulse[2] = increment_mm
        self._answer_a = _demand(closed_loop.simulate(*self._held, sync_period_s, impulse))
        self._lead = _Lead.of(self._answer_a, self._free)

    def quiet(self, reference_mm: Float, fixed: Float, state: State) -> Float:
        """Return the offset (n,) in whole increments for a rest (n,) of ``reference_mm`` that begins in ``state``.

        ``fixed`` (2,): the offsets of its first two rows, which are already used.
        """
        silent = float(state[POSITION] - reference_mm[0]) / self._increment_mm
        offset = np.full(reference_mm.size, silent)
        offset[:2] = fixed
        for first in range(0, reference_mm.size - 2, self._again):  # what rounding left is led away as well
            rest = reference_mm[first:]
            exact = np.full(rest.size, silent)
            exact[:2] = offset[first : first + 2]
            rows = min(self._answer_a.size, rest.size)
            free = min(rows - 2, self._free)
            base_a = _demand(self._simulate(rest, exact, state, rows))
            exact[2 : 2 + free] += self._lead.away(base_a, exact[:2] - silent)
            offset[first:] = kernels.rounded(exact, 2 + free, UNEVEN)
            state = self._simulate(rest, offset[first:], state, min(self._again, rest.size)).end
        return offset

    def _simulate(self, rest_mm: Float, offset: Float, state: State, rows: int) -> Response:
        ahead = min(rows + 2, rest_mm.size)  # a cycle looks two rows ahead and no further
        commanded = rest_mm[:ahead] + offset[:ahead] * self._increment_mm
        return closed_loop.simulate(*self._held, self._period_s, commanded, state=state, rows=rows)


def _held(parameters: Parameters, axis: Axis) -> tuple[Parameters, Axis]:
    """The same drive with a table that nothing moves, and without limits."""
    wide = axis.regulators.model_copy(update={"current_limit_a": 1e9, "voltage_limit_v": 1e9})
    return replace(parameters, Cd=HELD_NM), axis.model_copy(update={"regulators": wide})


def _demand(response: Response) -> Float:
    """Return the current demand (n,) at the end of each cycle."""
    return np.append(response.states[CURRENT_DEMAND, 1:], response.end[CURRENT_DEMAND])


@dataclass(frozen=True, slots=True)
class _Lead:
    """What an offset d from row 2 on does, as a cubic spline of knots ``step`` rows apart.

    ``spline`` (free + step, m) holds d's basis, ``bends`` its second differences, ``effect`` (n, m) what each of them
    asks for, in A. A rest of less than n rows uses their first rows.
    """

    free: int
    step: float
    spline: Float
    bends: Float
    effect: Float

    @staticmethod
    def of(answer_a: Float, free: int) -> _Lead:
        """Prepare for rests of up to ``free`` rows and longer; ``answer_a`` (n,): what an offset of 1 in row 2 does."""
        pieces = max(1, round(free / KNOT_ROWS))
        step = free / pieces
        knots = np.arange(-3, pieces + 5) * step
        spline = np.asarray(BSpline.design_matrix(np.arange(0.0, free + step), knots, 3).toarray())
        size = 2 * max(answer_a.size, len(spline))
        spectrum = np.fft.rfft(answer_a, size)[:, None] * np.fft.rfft(spline, size, axis=0)
        effect = np.ascontiguousarray(np.fft.irfft(spectrum, size, axis=0)[: answer_a.size])
        return _Lead(free, step, spline, np.diff(np.pad(spline, ((2, 0), (0, 0))), 2, axis=0), effect)

    def away(self, base_a: Float, before: Float) -> Float:
        """Return d (free,): least squares of the current base (n,) + effect and of d's bends.

        d ends in 0 with its slope, unless the rest ends first. ``before`` (2,) are its values in rows 0 and 1.
        """
        n = base_a.size
        free = min(n - 2, self.free)
        goes_on = n > free + 2
        columns = round(self.free / self.step) if goes_on else int(np.ceil(free / self.step)) + 3
        spline = self.spline[:free, :columns]
        seen = n if goes_on else n - 2  # the last cycles of a rest look at rows behind it
        effect, base_a = self.effect[:seen:EVERY, :columns], base_a[:seen:EVERY]
        bends = self.bends[: free + 2 if goes_on else free, :columns]
        smooth = (STEADINESS**2 / EVERY) * bends.T
        bent = smooth[:, 0] * (before[0] - 2 * before[1])
        if len(bends) > 1:
            bent = bent + smooth[:, 1] * before[1]
        stiffness = smooth @ bends
        stiffness[np.diag_indices(columns)] += RIDGE
        weighted, found = effect.T, np.zeros(columns)
        for _ in range(PASSES):  # the largest currents weigh most: it is they that break the table loose
            found = dposv(weighted @ effect + stiffness, -(weighted @ base_a) - bent)[1]
            weighted = effect.T * (1.0 + (base_a + effect @ found) ** 2)
        return np.asarray(spline @ found)
