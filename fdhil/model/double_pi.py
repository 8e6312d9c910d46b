"""Double PI: PI on position with speed feed-forward, PI on speed, PI on current.

The position integral (``position_ki_per_s2``) removes the lag that a drive without full speed feed-forward has at
constant speed; with dry friction it never fully settles. Both outer integrals are frozen while the current limit acts.
"""

from __future__ import annotations

from functools import partial

from fdhil.model import closed_loop_drive, closed_loop_kernels

prepare = partial(
    closed_loop_drive.prepare_drive_model, closed_loop_kernels.CASCADE, closed_loop_kernels.SET_POINT_BEFORE
)
