"""LinuxCNC's pid component on position, computed once per servo cycle, ahead of a speed or current drive.

The output is a motor speed u = FF0 r + P e + I sum(e) T + D de/dt + FF1 dr/dt + FF2 d2r/dt2 + FF3 d3r/dt3, all
differences over one cycle T, with dead band and output limit (LinuxCNC 2.9, hal/components/pid.c; the limits of single
terms are left out). ``pid_output`` "speed": u is the set-point of a drive with a PI on speed. "current": the drive uses
speed_kp u as its current demand, so that a gain of the component is speed_kp times the one here.
"""

from __future__ import annotations

from functools import partial

from fdhil.model import closed_loop_drive, closed_loop_kernels

prepare = partial(
    closed_loop_drive.prepare_drive_model, closed_loop_kernels.LINUXCNC, closed_loop_kernels.SPEED_FILTERED
)
