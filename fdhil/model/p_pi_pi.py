"""The default structure: P on position with speed feed-forward, PI on speed, PI on current ([DES] figure 1)."""

from __future__ import annotations

from functools import partial

from fdhil.model import closed_loop_drive, closed_loop_kernels

prepare = partial(
    closed_loop_drive.prepare_drive_model, closed_loop_kernels.CASCADE, closed_loop_kernels.POSITION_INTEGRAL
)
