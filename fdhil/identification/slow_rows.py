"""Tells what is not known of voltage and current within rows that are longer than a current regulator needs.

* A current that runs straight from reading to reading has, by [1], a voltage that rises over a row by R times the
  current's change and by L times the change of its slope, beside the back-EMF's. So it is where set-points are smooth;
  where they have a kink at every row, the current is ahead of that. All of the rise is one standard deviation.
* Where a drive draws straight lines between set-points, an accelerating table is ahead of the line between two of them,
  by a T^2 / 8 in the middle, and the regulators answer that anew in every row: readings at the rows' ends are off the
  mean of the current by a share of the accelerating one that grows with the square of the row.

Which it is depends on the drive, and is the same in all of its windows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.identification.kalman import JT, K, L, R
from fdhil.identification.motion import Motion, Within
from fdhil.records import Float

LEAST_ROW_S = 0.003  # in shorter rows both are less than a regulator's own doing
ROW_S, OFF_MEAN = 0.010, 0.08  # at such rows, with a speed loop of 40 Hz; a slower loop answers less


def with_open_course(motion: Motion, theta: Float) -> Motion:
    """Return the motion with what is open within its rows for ``theta`` (k,), where they are long and means."""
    if motion.dt_s < LEAST_ROW_S or motion.voltage_sampling != "interval_mean" or motion.slow is not None:
        return motion
    slope = np.gradient(motion.current, motion.dt_s)
    rise = theta[R] * np.diff(motion.current, append=motion.current[-1]) + theta[L] * np.diff(slope, append=slope[-1])
    accelerating = theta[JT] / theta[K] * np.gradient(motion.speed, motion.dt_s)
    off = OFF_MEAN * (motion.dt_s / ROW_S) ** 2 * accelerating
    still = np.zeros(motion.n)
    return replace(motion, within=Within(np.stack([rise, still]), np.stack([still, off])))
