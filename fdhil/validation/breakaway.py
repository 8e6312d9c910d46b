"""Measures breakaway: the torque impulse beyond the model's friction that delays the start of a move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdhil.identification import UNKNOWN_MODE, LikelihoodFit, compute_moving_mean, compute_term_torque_nm
from fdhil.records import Float, Reason, Window
from fdhil.validation.false_alarm_budget import BUDGET

SURE = BUDGET["standstill"].deviations
LEAST_BREAKAWAY = 0.02  # of the peak torque
AFTER_S = 0.015
HELD_SHARE = 0.7  # of dry friction: torque that cannot turn the shaft
LONGEST_BREAKAWAY_S = 0.060


@dataclass(frozen=True, slots=True)
class Breakaway:
    """A torque (N.m, against the positive direction) before row ``begin``, as the move begins.

    ``more``: it exceeds the model's; else it falls short of it.
    """

    excess_nm: float
    lasted_s: float
    begin: int
    exceeds_model: bool

    def integrate_torque(self, n: int) -> Float:
        """Return its integral over the rows (n,), N.m.s."""
        return np.where(np.arange(n) >= self.begin, self.excess_nm * self.lasted_s, 0.0)

    def build_reason(self) -> Reason:
        """Return the breakaway torque as a reason to refuse a window."""
        text = (
            f"beginning to move takes {abs(self.excess_nm):.3g} N.m {'more' if self.exceeds_model else 'less'} "
            f"over {1e3 * self.lasted_s:.0f} ms than friction drags (Stribeck)"
        )
        return Reason("ValidationFailed", text, "lubricate the slide-way, or check for a clamp or backlash")


def measure_breakaway(window: Window, fit: LikelihoodFit) -> Breakaway | None:
    """Return the additional torque needed to begin the move; None if it is insignificant or small.

    From rest, Jt w(t) is the integral of the excess of K i over dry friction, less viscous friction. The current's
    noise averages out in that integral, so the speed it predicts for the first rows in motion is sharp.
    """
    motion, theta = fit.problem.motions[0], fit.theta
    sure = np.flatnonzero(np.abs(motion.mode) == 1)
    if sure.size < 2 * AFTER_S / window.dt_s:
        return None
    begin, side = int(sure[0]), int(motion.mode[sure[0]])
    end = begin + round(AFTER_S / window.dt_s)
    still = _find_last_standstill_sample(fit, begin, side)
    if still is None:
        return None
    torque = side * theta[2] * motion.current[still:end]
    speed = side * motion.speed[still:end]
    drag = theta[5] + side * compute_term_torque_nm(motion, theta)[still:end]
    drag[: begin - still] = drag[begin - still]  # terms are known only where the shaft moves
    net = np.where(np.arange(still, end) < begin, np.maximum(torque - drag, 0.0), torque - drag)
    net = net - theta[4] * np.maximum(speed, 0.0)
    predicted = np.concatenate([[0.0], np.cumsum((net[1:] + net[:-1]) / 2)]) * window.dt_s / theta[3]
    late = predicted[begin - still :] - speed[begin - still :]
    spread = fit.problem.noises[0].speed_rad_s / np.sqrt(late.size)
    lasted = (begin - still) * window.dt_s
    excess = float(np.mean(late)) * theta[3] / lasted
    sure_by = SURE * spread * theta[3] / lasted
    peak = theta[2] * float(np.abs(motion.current).max())
    if abs(excess) <= sure_by + LEAST_BREAKAWAY * peak:
        return None
    return Breakaway(side * excess, lasted, begin, exceeds_model=excess > 0.0)


def _find_last_standstill_sample(fit: LikelihoodFit, begin: int, side: int) -> int | None:
    """Return the last row before the move at which the torque cannot turn the shaft; None without one."""
    motion, noise = fit.problem.motions[0], fit.problem.noises[0]
    rows = max(8, round(0.010 / motion.dt_s))
    first = max(rows, begin - round(LONGEST_BREAKAWAY_S / motion.dt_s))
    width = 2 * round(0.0005 / motion.dt_s) + 1
    torque = side * fit.theta[2] * compute_moving_mean(motion.current, width)
    holding = np.flatnonzero(torque[first:begin] < HELD_SHARE * fit.theta[5])
    if holding.size == 0:
        return None
    row = first + int(holding[-1])
    quiet = abs(float(motion.speed[row - rows : row + 1].mean())) < 4 * noise.speed_rad_s / np.sqrt(rows)
    unknown = bool((motion.mode[row - rows : row + 1] == UNKNOWN_MODE).all())
    return row if quiet and unknown and row < begin - 1 else None
