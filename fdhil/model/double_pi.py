"""Double PI: PI on position with speed feed-forward, PI on speed, PI on current.

The position integral (``position_ki_per_s2``) takes away the lag that a drive without full speed feed-forward has at
constant speed; with dry friction it never quite rests. While the current limit acts both outer integrals stand.
"""

from __future__ import annotations

from functools import partial

from fdhil.model import kernels, loops

prepare = partial(loops.prepare, kernels.CASCADE, kernels.SET_POINT_BEFORE)
