"""Bounds what a nearly right model leaves open, however many samples there are.

The d and q axes of a motor are not perfectly decoupled, windings and magnets saturate slightly, and friction is not
linear in speed. A deviation shaped like a parameter's own regressor leaves no residual: it counts as one standard
deviation of the parameter, common to all windows of a drive.
"""

from collections.abc import Mapping

import numpy as np

from fdhil.identification.kalman import CD, FT, K, L, R
from fdhil.identification.likelihood_fit import LikelihoodFit
from fdhil.records import Float

SHARES: Mapping[int, float] = {R: 0.008, L: 0.03, K: 0.0003}
CURVE_SHARE = 0.004  # of the friction at top speed: its deviation from a straight line over speed
CROSSING = 1.5  # top speed over the one at which the straight line meets the curve again


def estimate_model_doubts(result: LikelihoodFit) -> Float:
    """Return (k, 4) standard deviations of theta for unmodelled deviations shaped like R, L, K or friction."""
    theta, top = result.theta, max(float(np.abs(m.speed).max()) for m in result.problem.motions)
    doubts = np.zeros((theta.size, 4))
    for column, (entry, share) in enumerate(SHARES.items()):
        doubts[entry, column] = share * abs(float(theta[entry]))
    curve = CURVE_SHARE * (abs(float(theta[CD])) + abs(float(theta[FT])) * top)
    doubts[CD, 3], doubts[FT, 3] = curve, -CROSSING * curve / top if top > 0.0 else 0.0
    return doubts
