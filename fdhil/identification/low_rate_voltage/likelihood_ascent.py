"""Maximises the likelihood of windows with a low-rate voltage, by Fisher scoring on all innovations.

The variance of an innovation depends on the parameters too, through L / T, so the determinant is included.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.identification.identifiability import is_admissible
from fdhil.identification.kalman import DELAY
from fdhil.identification.low_rate_voltage.low_rate_innovations import (
    LowRateInnovations,
    compute_low_rate_innovations,
    compute_shift_room_s,
)
from fdhil.identification.normal_equations import invert_symmetric
from fdhil.identification.prepared_motion import Motion, NoiseLevels
from fdhil.records import Float

STEPS = 60
CONVERGED = 0.01  # of a standard deviation
DIFFERENCE = 1e-5  # of a parameter's typical size
DELAY_DIFFERENCE_S = 1e-6
LEAST_DIFFERENCE_S = 1e-8
LEAST_SHARE, MOST_SHARE = 1e-3, 256.0
REACH, SPACING = 1.5, 0.125  # samples of the voltage
GAIN = 1e-3  # of twice the log likelihood: smaller gains move theta by some hundredths of a deviation


@dataclass(frozen=True, slots=True)
class LowRateLikelihood:
    """Windows with a low-rate voltage and their noise levels."""

    motions: tuple[Motion, ...]
    noises: tuple[NoiseLevels, ...]

    def compute_innovations(self, theta: Float, ordered_for_s: float | None = None) -> LowRateInnovations:
        """Return all innovations for ``theta`` (7,), ordered for a delay of ``ordered_for_s`` (default: its own)."""
        pairs = zip(self.motions, self.noises, strict=True)
        made = [compute_low_rate_innovations(m, theta, s.to_array() ** 2, ordered_for_s) for m, s in pairs]
        return LowRateInnovations(
            np.concatenate([one.values for one in made]), np.concatenate([one.variance for one in made])
        )

    def compute_slopes(
        self, here: LowRateInnovations, theta: Float, free: Sequence[int], sizes: Float
    ) -> tuple[Float, Float]:
        """Return minus the derivatives (m, k) of innovations by ``free``, in deviations, and of half the log variance.

        The order of samples is kept, so that an innovation stays that of the same sample. The delay is varied to the
        side with more room, and by no more than that.
        """
        deviation, order = np.sqrt(here.variance), float(theta[DELAY])
        of_mean, of_variance = np.empty((here.values.size, len(free))), np.empty((here.values.size, len(free)))
        for k, j in enumerate(free):
            moved = theta.copy()
            moved[j] += self._choose_delay_step(order) if j == DELAY else DIFFERENCE * sizes[j]
            there = self.compute_innovations(moved, order)
            change = moved[j] - theta[j]
            of_mean[:, k] = (here.values - there.values) / deviation / change
            of_variance[:, k] = (np.log(here.variance) - np.log(there.variance)) / 2 / change
        return of_mean, of_variance

    def _choose_delay_step(self, delay_s: float) -> float:
        rooms = [compute_shift_room_s(motion, delay_s) for motion in self.motions]
        earlier, later = min(room[0] for room in rooms), min(room[1] for room in rooms)
        # a longer delay moves a sample earlier
        step = min(DELAY_DIFFERENCE_S, max(max(earlier, later) / 2, LEAST_DIFFERENCE_S))
        return step if earlier >= later else -step


def maximise_likelihood(
    likelihood: LowRateLikelihood, theta: Float, free: Sequence[int], sizes: Float
) -> tuple[Float, Float, Float, bool]:
    """Step from ``theta`` (7,), with typical ``sizes`` (7,); return theta, innovations (m,), jacobian (m, k), and
    success.
    """
    here = likelihood.compute_innovations(theta)
    for _ in range(STEPS):
        white = here.whitened
        mean, variance = likelihood.compute_slopes(here, theta, free, sizes)
        information = mean.T @ mean + 2 * variance.T @ variance
        if not np.isfinite(information).all() or (np.diag(information) == 0).any():
            return theta, white, mean, False
        step = invert_symmetric(information)[0] @ (mean.T @ white + variance.T @ (1.0 - white**2))
        if float(np.abs(step * np.sqrt(np.diag(information))).max()) < CONVERGED:
            return theta, white, mean, True
        found = _search_along_step(likelihood, theta, here, free, step)
        if found is None:
            return theta, white, mean, True  # nothing likelier along the step: the maximum, to rounding
        gained, (theta, here) = here.cost - found[1].cost, found
        if gained < GAIN:
            return theta, here.whitened, mean, True
    return theta, here.whitened, mean, False


def _search_along_step(
    likelihood: LowRateLikelihood, theta: Float, here: LowRateInnovations, free: Sequence[int], step: Float
) -> tuple[Float, LowRateInnovations] | None:
    """Return a likelier theta along the ``step`` and its innovations; None without one.

    A step that is not likelier is halved; a full one is doubled while that is likelier, because noisy innovations
    overrate the information on the delay and make steps too short.
    """

    def try_share(share: float) -> tuple[Float, LowRateInnovations] | None:
        trial = theta.copy()
        trial[list(free)] += share * step
        if not is_admissible(trial):
            return None
        there = likelihood.compute_innovations(trial)
        return (trial, there) if there.cost <= here.cost else None

    share = 1.0
    while share > LEAST_SHARE:
        best = try_share(share)
        if best is not None:
            break
        share *= 0.5
    else:
        return None
    while 1.0 <= share < MOST_SHARE:
        share *= 2.0
        further = try_share(share)
        if further is None or not further[1].cost < best[1].cost:
            break
        best = further
    return best


def find_likelier_delay(
    likelihood: LowRateLikelihood, theta: Float, information: Float, period_s: float
) -> Float | None:
    """Return theta (7,) with a significantly likelier delay, up to ``REACH`` samples off; None without one.

    Whether a sample ends before or after another makes the likelihood uneven, with local maxima a fraction of a sample
    apart. The other parameters follow the delay by the ``information`` (7, 7).
    """
    inverse = invert_symmetric(information)[0]
    if not (np.isfinite(inverse).all() and inverse[DELAY, DELAY] > 0.0):
        return None
    ridge = inverse[:, DELAY] / inverse[DELAY, DELAY]
    shifts = np.arange(-REACH, REACH + SPACING / 2, SPACING) * period_s
    trials: list[Float] = [theta + shift * ridge for shift in shifts]
    possible = [t for t in trials if is_admissible(t)]
    costs = np.array([likelihood.compute_innovations(t).cost for t in possible])
    here = likelihood.compute_innovations(theta).cost
    if costs.size == 0 or not costs.min() < here - GAIN:
        return None
    return possible[int(np.argmin(costs))]
