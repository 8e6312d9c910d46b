"""LinuxCNC's pid component on position, computed once a servo cycle, in front of a drive for speed or for current.

The output is a motor speed u = FF0 r + P e + I sum(e) T + D de/dt + FF1 dr/dt + FF2 d2r/dt2 + FF3 d3r/dt3, all
differences over one cycle T, with dead band and output limit (LinuxCNC 2.9, hal/components/pid.c; the limits of single
terms are left out). ``pid_output`` "speed": u goes to a drive with a PI on speed. "current": the drive takes
speed_kp u for its current, so that a gain of the component is speed_kp times the one here.
"""

from __future__ import annotations

from functools import partial

from fdhil.model import kernels, loops

prepare = partial(loops.prepare, kernels.LINUXCNC, kernels.SPEED_FILTERED)
