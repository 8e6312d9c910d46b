"""Plans a wanted offset inside its limits, so that the guard never has to clip it, and checks a table against them.

In drive increments per SYNC cycle: amplitude L, rate S, acceleration A, total variation E within one second. L is
braking-aware: |o| + v^2 / (2 A) <= L while the offset moves outward at v.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter1d

from fdhil.config import VARIATION_MM, Axis, OffsetBounds
from fdhil.correction import offset_kernels
from fdhil.records import Bool, Float, Int, Reason

# rounding a curve to whole increments moves its first difference by up to 1, its second by up to 2
ROUNDING_RATE, ROUNDING_ACCELERATION = 1.0, 2.0
_PASSES = 8
_NEAR = 150  # rows around a violation that are planned again with it
_SLACK = 0.05  # increments by which a seam may miss, far below the rounding


@dataclass(frozen=True, slots=True)
class PlanLimits(OffsetBounds):
    """The limits of an offset in increments, and their size."""

    um_per_increment: float

    @staticmethod
    def derive(axis: Axis, sync_period_s: float) -> PlanLimits:
        """Return the limits of an axis; ValueError when writing is off (no ``[axis.X.correction]``)."""
        allowed = OffsetBounds.derive(axis, sync_period_s)
        return PlanLimits(**asdict(allowed), um_per_increment=1e3 / axis.scaling.increments_per_mm)

    @property
    def curve_limits(self) -> PlanLimits:
        """The limits of a curve that is rounded afterwards: reduced by the rounding, where that leaves enough."""
        return replace(
            self,
            offset=self.offset - 0.5,
            rate=max(self.rate - ROUNDING_RATE, 0.5 * self.rate),
            acceleration=self.acceleration - ROUNDING_ACCELERATION
            if self.acceleration >= 2 * ROUNDING_ACCELERATION
            else self.acceleration,
        )


def check_offsets(offset_increments: Int, limits: PlanLimits, before: tuple[float, float] = (0.0, 0.0)) -> list[Reason]:
    """Return the limits that a table (n,) violates: ``OffsetLimit``, ``OffsetRate``, ``OffsetEnergy``, with its figure.

    ``before``: the two offsets ahead of the first row, the nearer one first. Rounding to increments is tolerated.
    """
    um = limits.um_per_increment
    _, fast, hard, reach, travel = offset_kernels.measure_extent(
        offset_increments.astype(np.float64),
        np.array(before),
        limits.acceleration + ROUNDING_ACCELERATION,
        limits.window,
    )
    reasons = []
    if not reach <= limits.offset + 0.5:
        text = f"the offset reaches {reach * um:.0f} um, braking included; {limits.offset * um:.0f} are allowed"
        reasons.append(Reason("OffsetLimit", text, "plan the correction inside the limits"))
    if not fast <= limits.rate + ROUNDING_RATE or not hard <= limits.acceleration + ROUNDING_ACCELERATION:
        text = f"the offset moves {fast * um:.1f} um and changes that by {hard * um:.1f} um in a cycle"
        reasons.append(Reason("OffsetRate", text, "plan the correction inside the limits"))
    if not travel <= limits.variation:
        text = f"the offset travels {travel * um * 1e-3:.1f} mm in one second; {VARIATION_MM:.0f} are allowed"
        reasons.append(Reason("OffsetEnergy", text, "plan a smoother correction"))
    return reasons


def compute_variation(rate: Float, window: int) -> Float:
    """Return (n,) the travel within the ``window`` cycles that end at each row."""
    total = np.concatenate([[0.0], np.cumsum(np.abs(rate))])
    rows = np.arange(1, total.size)
    return np.asarray(total[rows] - total[np.maximum(rows - window, 0)])


def fit_within_limits(wanted: Float, limits: PlanLimits, before: tuple[float, float] = (0.0, 0.0)) -> Float:
    """Return the curve (n,) nearest to ``wanted`` (increments, n) that keeps the limits, ready to be rounded."""
    curve = limits.curve_limits
    goal = np.ascontiguousarray(np.clip(wanted, -4 * curve.offset, 4 * curve.offset))
    amplitude = curve.offset
    planned = goal
    for _ in range(_PASSES):
        planned = _project_broken_rows(goal, replace(curve, offset=amplitude), before)
        _, _, _, reach, longest = offset_kernels.measure_extent(
            planned, np.array(before), curve.acceleration, curve.window
        )
        excess = reach - curve.offset
        if excess <= 1e-6 * curve.offset and longest <= 0.98 * curve.variation:
            return planned
        travel = compute_variation(np.diff(planned, prepend=before[0]), curve.window)
        if excess > 1e-6 * curve.offset:
            amplitude = max(amplitude - 1.05 * excess, 0.2 * amplitude)
        goal = goal * _compute_travel_factor(travel, 0.95 * curve.variation, curve.window)
    if before != (0.0, 0.0):
        return _project_broken_rows(np.zeros_like(goal), curve, before)
    # a curve that starts from rest and is scaled down keeps every limit that it kept before
    _, _, _, reach, longest = offset_kernels.measure_extent(planned, np.zeros(2), curve.acceleration, curve.window)
    return np.asarray(planned / max(longest / (0.98 * curve.variation), reach / curve.offset, 1.0))


def _project_broken_rows(goal: Float, limits: PlanLimits, before: tuple[float, float]) -> Float:
    """Project onto rate, acceleration and amplitude; far from violations the goal stays as it is."""
    high, fast, hard, _, _ = offset_kernels.measure_extent(goal, np.array(before), limits.acceleration, limits.window)
    if high <= limits.offset and fast <= limits.rate and hard <= limits.acceleration:
        return goal
    broken = np.flatnonzero(_find_violations(goal, limits, before))
    result = goal.copy()
    bounds = np.array([limits.offset, limits.rate, limits.acceleration])
    apart = np.flatnonzero(np.diff(broken) > 2 * _NEAR) + 1
    for rows in np.split(broken, apart):
        first, last = max(0, int(rows[0]) - _NEAR), min(goal.size, int(rows[-1]) + _NEAR)
        ahead = (
            before if first == 0 else (float(result[first - 1]), before[0] if first == 1 else float(result[first - 2]))
        )
        result[first:last] = offset_kernels.project_onto_limits(goal[first:last], bounds, np.array(ahead))
    if _find_violations(result, limits, before, _SLACK).any():
        return offset_kernels.project_onto_limits(goal, bounds, np.array(before))
    return result


def _find_violations(offset: Float, limits: PlanLimits, before: tuple[float, float], slack: float = 0.0) -> Bool:
    rate = np.diff(offset, prepend=before[0])
    acceleration = np.diff(rate, prepend=before[0] - before[1])
    return np.asarray(
        (np.abs(offset) > limits.offset + slack)
        | (np.abs(rate) > limits.rate + slack)
        | (np.abs(acceleration) > limits.acceleration + slack)
    )


def _compute_travel_factor(travel: Float, allowed: float, window: int) -> Float:
    """Return a factor (n,) <= 1 that reduces the offset where its travel within a second is too long."""
    if travel.max(initial=0.0) <= allowed:
        return np.ones(travel.size)
    factor = np.minimum(1.0, allowed / np.maximum(travel, 1e-12))
    # a row belongs to all windows that end within the next second; smoothed, so that the factor adds no jerk
    lowest = minimum_filter1d(factor, window + 1, mode="nearest", origin=-((window + 1) // 2))
    smooth = max(1, window // 20)
    padded = np.pad(lowest, smooth, mode="edge")
    kernel = np.hanning(2 * smooth + 1)
    return np.asarray(np.minimum(np.convolve(padded, kernel / kernel.sum(), mode="valid"), 1.0))


def round_to_increments(offset: Float) -> Int:
    """Round a planned curve (n,) to whole increments."""
    return np.rint(offset).astype(np.int64)


def fit_all_axes(wanted_um: Mapping[str, Float], axes: Mapping[str, Axis], sync_period_s: float) -> dict[str, Float]:
    """Plan the wanted offsets of all axes inside their limits; return them in um, in whole increments."""
    planned: dict[str, Float] = {}
    for name, wanted in wanted_um.items():
        limits = PlanLimits.derive(axes[name], sync_period_s)
        whole = round_to_increments(fit_within_limits(wanted / limits.um_per_increment, limits))
        planned[name] = whole.astype(np.float64) * limits.um_per_increment
    return planned
