"""Bounds what a model that is nearly right leaves open, however many samples there are.

Between the axes d and q of a motor a voltage of some 1e-4 of the peak is lost that no term has, and friction is no
straight line over speed. Where such a remainder has the shape of a parameter's own regressor, no residual shows it:
its size over that of the regressor is one standard deviation of the parameter, the same in all windows of a drive.
"""

from __future__ import annotations

import numpy as np

from fdhil.identification.filtering import moving_mean
from fdhil.identification.fit import Fit
from fdhil.identification.kalman import CD, FT, K, L, R
from fdhil.identification.motion import Motion
from fdhil.records import Float, rms

REMAINDER_SHARE = 2e-4  # of the largest voltage
SMOOTHING_S = 0.005
CURVE_SHARE = 0.004  # of the friction at top speed, by which a straight line over speed misses it
CROSSING = 1.5  # top speed over the one at which the straight line meets the curve again


def model_doubts(result: Fit) -> Float:
    """Return (k, 4) one standard deviation of the entries of theta for a remainder shaped as R, L, K or friction."""
    motions, theta = result.problem.motions, result.theta
    volts = REMAINDER_SHARE * max(float(np.abs(m.voltage_mean).max()) for m in motions)
    regressors = (
        (R, [m.current for m in motions]),
        (L, [_slope(m) for m in motions]),
        (K, [m.speed for m in motions]),
    )
    doubts = np.zeros((theta.size, 4))
    for column, (entry, signals) in enumerate(regressors):
        size = rms(np.concatenate(signals))
        doubts[entry, column] = volts / size if size > 0.0 else 0.0
    top = max(float(np.abs(m.speed).max()) for m in motions)
    curve = CURVE_SHARE * (abs(float(theta[CD])) + abs(float(theta[FT])) * top)
    doubts[CD, 3] = curve
    doubts[FT, 3] = -CROSSING * curve / top if top > 0.0 else 0.0
    return doubts


def _slope(motion: Motion) -> Float:
    """Return the slope (n,) of the current, A/s, without most of its noise."""
    smooth = moving_mean(motion.current, 2 * round(SMOOTHING_S / motion.dt_s / 2) + 1)
    slope: Float = np.gradient(smooth, motion.dt_s)
    return slope
