"""PID on position whose output is the current demand; PI on current. There is no speed loop and no speed sensor.

P = speed_kp x position_gain_per_s (A/rad), I = speed_kp x position_ki_per_s2 (A/(rad.s)), D = speed_kp (A.s/rad). The
derivative is the difference of ``speed_feedforward`` x set-point - position over one cycle of ``speed_period_s``: with
1 it acts on the error, with 0 on the position alone. The integral is frozen while the current limit acts.

Apart from when the demanded speed takes effect, a cascade of P and PI with full feed-forward equals the PID with
position_gain_per_s = Kv + Ki/Kp and position_ki_per_s2 = Kv Ki/Kp.
"""

from __future__ import annotations

from functools import partial

from fdhil.model import closed_loop_drive, closed_loop_kernels

prepare = partial(closed_loop_drive.prepare_drive_model, closed_loop_kernels.PID, closed_loop_kernels.FILTERED)
