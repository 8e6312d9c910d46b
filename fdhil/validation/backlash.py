"""Measures backlash: how far the motor turns before the table follows, in micrometres at the table.

While the table stands still, the integral of the motor's speed is the part of the dead band that is crossed. It is
measured from the sample in which the current leaves its level of standstill up to the sample in which the table moves,
less the table's motion by then; its standard deviation is that of the integral, with the uncertainty of the speed's
zero. When the motor brakes, the table coasts through the same dead band to its other flank: a second measurement, which
a screw's wind-up disturbs too, so that it may confirm the first but not replace it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdhil.identification import (
    compute_moving_mean,
    estimate_noise_levels,
    fill_forward,
    find_moving_range,
    find_resolution,
)
from fdhil.records import Float, Reason, Window
from fdhil.validation.false_alarm_budget import BUDGET

LIKELY = 2.0  # of the first measurement, which the second may confirm
LEAST_UM = 20.0  # wind-up of a screw before the table starts, which is no backlash
WOUND_UP_UM = 60.0  # a screw's wind-up as it unwinds and winds up again from driving to braking
LEAST_ROWS = 8
AFTER_S = 0.003  # by then the table follows and the dead band is crossed
LONGEST_S = 0.060  # before the table moves: a longer integral gathers more noise than dead band
SMOOTHING_S = 0.002
CHANGED = 5.0  # standard deviations by which a current leaves its level of standstill
BEYOND_NOISE = 3.0  # standard deviations of the noise in a drop of the speed
CROSSED_UM = 150.0  # travel of the coasting table at which the second measurement ends


@dataclass(frozen=True, slots=True)
class DeadBand:
    """Dead band ``um`` at the table with its standard deviation ``compute_std_um``."""

    um: float
    std_um: float

    @property
    def is_significant(self) -> bool:
        """Return whether it is significant."""
        return abs(self.um) > BUDGET["play"].deviations * self.std_um

    def build_reason(self) -> Reason:
        """Return the dead band as a reason to refuse a window."""
        text = f"the motor turns {self.um:.0f} ± {self.std_um:.0f} um before the table follows (backlash)"
        return Reason("ValidationFailed", text, "check screw, nut, coupling and bearings for play")


@dataclass(frozen=True, slots=True)
class _AxialMotion:
    """The move in its own direction: position (mm) and speed (mm/s) at the table (n,), and the current (n,)."""

    position_mm: Float
    speed_mm_s: Float
    current: Float
    dt_s: float
    quantum_mm: float
    noise_mm: float  # of the speed's integral over one row
    width: int  # rows over which the current is smoothed
    current_noise: float  # before that

    def measure_lost_motion_um(self, a: int, b: int, zero_mm_s: float) -> float:
        turned = float(((self.speed_mm_s[a:b] + self.speed_mm_s[a + 1 : b + 1]) / 2 - zero_mm_s).sum()) * self.dt_s
        return 1e3 * (turned - float(self.position_mm[b] - self.position_mm[a]))

    def compute_std_um(self, a: int, b: int, zero_rows: float) -> float:
        """Return the standard deviation of that, with a zero that is the mean of ``zero_rows``.

        The flanks may meet at any time between two samples of the speed, which drops there.
        """
        rows = b - a
        chance = self.noise_mm * math.sqrt(rows + rows**2 / zero_rows)
        drop = float(np.abs(np.diff(self.speed_mm_s[a : b + 1])).max()) * self.dt_s - BEYOND_NOISE * self.noise_mm
        return 1e3 * math.hypot(chance, max(drop, 0.0) / math.sqrt(12), self.quantum_mm / math.sqrt(6))


def _extract_axial_motion(window: Window) -> _AxialMotion | None:
    position = window.direction * fill_forward(window.position_mm)
    quantum = find_resolution(position)
    if quantum == 0.0 or not np.isfinite(window.current_a).any():
        return None
    to_mm = window.pitch_mm / (2 * math.pi)
    levels = estimate_noise_levels(window)
    width = 2 * round(SMOOTHING_S / 2 / window.dt_s) + 1
    current = window.direction * compute_moving_mean(fill_forward(window.current_a), width)
    speed = window.direction * to_mm * fill_forward(window.speed_rad_s)
    noise = levels.speed_rad_s * window.dt_s * to_mm
    return _AxialMotion(position, speed, current, window.dt_s, quantum, noise, width, levels.current_a)


def measure_dead_band(window: Window) -> DeadBand | None:
    """Return how far the motor turns before the table follows; None without a recorded position or standstill."""
    begin, end = find_moving_range(window)
    course = _extract_axial_motion(window)
    if course is None or window.stages.accelerate is None or begin < LEAST_ROWS:
        return None
    # from this row on the table moves
    limit = 3 * course.quantum_mm + 1e-3
    moves = np.flatnonzero(np.abs(course.position_mm[:end] - course.position_mm[0]) > limit)
    if moves.size == 0:
        return None
    first = int(moves[0])
    start = max(LEAST_ROWS, first - round(LONGEST_S / window.dt_s))
    stop = min(first + max(1, round(AFTER_S / window.dt_s)), end, window.n - 1)
    if not np.isfinite(window.speed_rad_s[:stop]).all() or start >= stop:
        return None
    start = _find_torque_onset(course, start, first)
    # the axis may still settle from its last move, which is no offset of the speed; within its dead band that is
    # not observable after the move
    return DeadBand(
        course.measure_lost_motion_um(start, stop, _measure_speed_offset(course, 0, start)),
        course.compute_std_um(start, stop, start),
    )


def _measure_speed_offset(course: _AxialMotion, a: int, b: int) -> float:
    """Return the speed's reading (mm/s) beyond the table's own motion from row ``a`` to ``b``."""
    moved = float(course.position_mm[b] - course.position_mm[a]) / ((b - a) * course.dt_s)
    return float(course.speed_mm_s[a:b].mean()) - moved


def _find_torque_onset(course: _AxialMotion, start: int, first: int) -> int:
    """Return the last row from ``start`` to ``first`` with the current of standstill: no motor turns yet."""
    still, noise = course.current[:start], course.current_noise
    if still.size < 2 * course.width or float(np.ptp(still)) > 2 * CHANGED * noise:
        return start  # it still settles from the last move
    allowed = CHANGED * noise * math.sqrt(1 / course.width + 1 / still.size)
    same = np.flatnonzero(np.abs(course.current[start:first] - float(still.mean())) <= allowed)
    return start + (int(same[-1]) if same.size else 0)


def measure_overrun(window: Window) -> DeadBand | None:
    """Return how much more the table moves than the motor when braking begins; None where that is not observable.

    The force on the table reverses with the motor's torque: from there on the table would coast, and leads the motor by
    the second integral of the braking deceleration, until its other flank is reached.
    """
    course = _extract_axial_motion(window)
    stages = window.stages
    if course is None or stages.accelerate is None or stages.cruise is None or stages.brake is None:
        return None
    (a, b), (_, end) = stages.cruise, stages.brake
    last = min(end, window.n - 1)
    if not np.isfinite(window.speed_rad_s[a:last]).all():
        return None
    driven = np.flatnonzero(course.current[a:last] >= 0.0)
    gain = _estimate_acceleration_gain(course, *stages.accelerate, float(np.median(course.current[a:b])))
    braking = np.flatnonzero(course.current[max(a, b - round(LONGEST_S / window.dt_s)) : last] < 0.0)
    if driven.size == 0 or braking.size == 0 or not gain > 0.0:
        return None
    start = max(a, b - round(LONGEST_S / window.dt_s)) + int(braking[0])
    ahead = np.cumsum(np.cumsum(np.maximum(-course.current[start:last], 0.0))) * gain * window.dt_s**2
    crossed = np.flatnonzero(ahead > 1e-3 * CROSSED_UM)
    if crossed.size == 0 or crossed[0] * window.dt_s > LONGEST_S or start - a < LEAST_ROWS:
        return None
    stop = min(start + int(crossed[0]) + 1, last)
    # gain and zero of the speed are those of the cruise before
    zero = _measure_speed_offset(course, a, start)
    return DeadBand(-course.measure_lost_motion_um(start, stop, zero), course.compute_std_um(start, stop, start - a))


def _estimate_acceleration_gain(course: _AxialMotion, a: int, b: int, cruising: float) -> float:
    """Return the acceleration (mm/s2) of the whole drive per unit of current, friction taken from the cruise."""
    pushed = float((course.current[a:b] - cruising).sum()) * course.dt_s
    return float(course.speed_mm_s[b - 1] - course.speed_mm_s[a]) / pushed if pushed > 0.0 else 0.0


def detect_backlash(window: Window) -> DeadBand | None:
    """Return the dead band if it is significant and larger than a screw's wind-up explains."""
    found = measure_dead_band(window)
    if found is None or found.um <= LEAST_UM:
        return None
    if found.is_significant:
        return found
    second = measure_overrun(window)
    if found.um <= LIKELY * found.std_um or second is None or second.um <= WOUND_UP_UM:
        return None
    weights = found.std_um**-2, second.std_um**-2
    both = DeadBand((found.um * weights[0] + second.um * weights[1]) / sum(weights), sum(weights) ** -0.5)
    return both if both.is_significant else None
