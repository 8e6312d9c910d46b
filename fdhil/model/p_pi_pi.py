"""The default structure: P on position with speed feed-forward, PI on speed, PI on current ([DES] figure 1)."""

from __future__ import annotations

from functools import partial

from fdhil.model import kernels, loops

prepare = partial(loops.prepare, kernels.CASCADE, kernels.POSITION_INTEGRAL)
