"""Checks that a rapid was executed as ordered: one plateau, equal ramps, at rest where the demand rests.

Feed override and feed hold change the speed on the way; an abort brakes harder than any planned ramp or leaves the
demand behind. Position and demand show it, so that no fault of the speed sensor is mistaken for one. A slower rapid at
a constant override keeps its three stages and is valid, unless the NC reports the override: such a rapid is refused. A
hold that comes to rest leaves two complete moves.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fdhil.identification import compute_moving_mean, find_longest_run, interpolate_gaps
from fdhil.records import Float, NcMove, Reason, Window
from fdhil.validation.window_signals import WindowSignals

CODE = "EpisodeAborted"
ADVICE = "record a rapid without feed hold, override change or stop"
LABORATORY = "record a whole move from rest to rest, or identify from any move with --any-move (any_move=True)"
NC_ADVICE = "only rapids at an override of 100 % and without feed hold are used"
OVERRIDE = 0.005  # that is still 100 %
SMOOTHING_S = 0.020
TOP = 0.95
OVERSHOOT = 0.85
RAMP_S = 0.005
LEAST_DIP = 0.06  # of the plateau: a drive's lag along one ramp stays below
HELD_S = 0.040
HELD_RATE = 0.2  # of the steepest ramp: a speed that changes more slowly is held
BETWEEN = (0.1, 0.92)  # of the plateau: a ramp with limited jerk is slow only beyond them
HARDER = 2.0
MOVES_ON = 0.03  # of the plateau: a demand that rests, or reverses, is slower in some row
LEFT_MM = 1.0
LEFT_SHARE = 0.01


def find_interruptions(signals: WindowSignals) -> Iterator[Reason]:
    """Yield the reason why the window is not a complete rapid, with the figure that shows it."""
    window = signals.window
    if window.nc is not None and (message := _read_nc_report(window.nc)) is not None:
        yield Reason(CODE, message, NC_ADVICE)
        return
    a, b = (min(row, window.n) for row in signals.motion_range)
    speed = _differentiate_position(window.position_mm, window)
    if speed is None or b - a < 8:
        return
    plateau = _estimate_plateau_speed(window, speed[a:b], speed)
    if plateau <= 0:
        return
    seen = np.clip(speed[a:b], 0.0, plateau)
    reason = (
        _find_position_deficit(window, b)
        or _find_demand_in_motion(window, a, b, plateau)
        or _find_speed_dip(window, seen, plateau, a, np.maximum.accumulate(speed[a:b]) - plateau)
        or _find_held_speed(window, seen, plateau, a)
    )
    reason = reason or _find_quick_stop(window, a, b)
    if reason is not None:
        yield Reason(CODE, reason, ADVICE if np.isfinite(window.demand_mm).any() else LABORATORY)


def _read_nc_report(nc: NcMove) -> str | None:
    where = "" if nc.line is None else f" in line {nc.line}"
    if nc.held:
        return f"the NC reports a feed hold{where}"
    if nc.override is not None and max(abs(1.0 - override) for override in nc.override) > OVERRIDE:
        least, greatest = nc.override
        share = (
            f"{100 * least:.0f} %" if greatest - least < OVERRIDE else f"{100 * least:.0f} to {100 * greatest:.0f} %"
        )
        return f"the NC reports an override of {share}{where}"
    return None


def _estimate_plateau_speed(window: Window, moving: Float, speed: Float) -> float:
    """Return the plateau speed: the longest level, or a higher one that no overshoot explains."""
    high = float(np.quantile(moving, TOP))
    if window.stages.cruise is None:
        return high
    held = speed[slice(*window.stages.cruise)]
    if held.size == 0:
        return high
    longest_level = float(np.median(held))
    return longest_level if longest_level >= OVERSHOOT * high else high


def _differentiate_position(position_mm: Float, window: Window, seconds: float = SMOOTHING_S) -> Float | None:
    """Return the speed (n,) in the window's direction, mm/s, of a position; None where there is none."""
    known = position_mm[np.isfinite(position_mm)]
    if known.size < 2 or np.ptp(known) == 0.0:
        return None
    position = interpolate_gaps(position_mm)  # constant speed across a gap
    width = 2 * round(seconds / window.dt_s / 2) + 1
    if position.size < width:
        return None
    course: Float = compute_moving_mean(window.direction * np.gradient(position, window.dt_s), width)
    return course


def _find_speed_dip(window: Window, seen: Float, plateau: float, begin: int, overshoot: Float) -> str | None:
    """Return where the speed falls and rises again, unless it had overshot the plateau by more before."""
    before = np.maximum.accumulate(seen)
    after = np.maximum.accumulate(seen[::-1])[::-1]
    depth = np.minimum(before, after) - seen
    k = int(np.argmax(depth))
    if depth[k] <= max(LEAST_DIP * plateau, overshoot[k]):
        return None
    lowest_s = _format_time(window, begin + k)
    return f"the speed falls from {plateau:.4g} to {seen[k]:.4g} mm/s at {lowest_s} s and rises again"


def _find_held_speed(window: Window, seen: Float, plateau: float, begin: int) -> str | None:
    reach = max(1, round(SMOOTHING_S / 2 / window.dt_s))  # the position's steps hide the rate from row to row
    if seen.size <= 2 * reach:
        return None
    rate = np.abs(seen[2 * reach :] - seen[: -2 * reach])
    middle = seen[reach:-reach]
    between = (middle > BETWEEN[0] * plateau) & (middle < BETWEEN[1] * plateau)
    start, end = (row + reach for row in find_longest_run(between & (rate < HELD_RATE * rate.max())))
    if (end - start) * window.dt_s < HELD_S:
        return None
    level = float(np.median(seen[start:end]))
    demand = _differentiate_position(window.demand_mm, window, RAMP_S)
    if demand is not None and np.median(demand[begin + start : begin + end]) > BETWEEN[1] * plateau:
        return None  # the drive creeps towards a speed that is demanded already
    fast = np.flatnonzero((middle >= BETWEEN[1] * plateau) | (rate >= HELD_RATE * rate.max()))
    fast = fast[fast >= end - reach]
    if demand is None and fast.size and middle[fast[0]] >= BETWEEN[1] * plateau:
        return None  # it gets there without another ramp: the regulator settles
    return (
        f"the speed is held at {level:.4g} mm/s for {1e3 * (end - start) * window.dt_s:.0f} ms from "
        f"{_format_time(window, begin + start)} s, below its plateau of {plateau:.4g} mm/s"
    )


def _find_quick_stop(window: Window, begin: int, end: int) -> str | None:
    """Compare the ramps of the demand: an NC plans both with the same acceleration."""
    speed = _differentiate_position(window.demand_mm, window, RAMP_S)
    reach = max(1, round(RAMP_S / 2 / window.dt_s))
    if speed is None or end - begin <= 2 * reach or window.stages.accelerate is None or window.stages.brake is None:
        return None
    part = speed[max(0, begin - reach) : end + reach]
    rate = (part[2 * reach :] - part[: -2 * reach]) / (2 * reach * window.dt_s)
    up, down = float(rate.max()), float(-rate.min())
    if up <= 0 or down <= HARDER * up:
        return None
    return f"the demand brakes with {down * 1e-3:.3g} m/s2 after accelerating with {up * 1e-3:.3g} m/s2"


def _find_position_deficit(window: Window, end: int) -> str | None:
    demand = window.demand_mm[np.isfinite(window.demand_mm)]
    if window.stages.brake is None or demand.size == 0 or np.ptp(demand) == 0.0:
        return None
    apart = (window.demand_mm - window.position_mm)[end:]
    apart = apart[np.isfinite(apart)]
    if apart.size == 0:
        return None
    least = float(apart[np.argmin(np.abs(apart))])
    travel = float(np.ptp(window.position_mm[np.isfinite(window.position_mm)]))
    if abs(least) <= LEFT_MM + LEFT_SHARE * travel:
        return None
    return f"the axis comes to rest {abs(least):.3g} mm from its demand"


def _find_demand_in_motion(window: Window, begin: int, end: int, plateau: float) -> str | None:
    """Return whether the drive only passes through rest, before or after the move, while its demand goes on."""
    speed = _differentiate_position(window.demand_mm, window, RAMP_S)
    if speed is None:
        return None
    reach = max(1, round(RAMP_S / window.dt_s))
    stages = window.stages
    for ended, part in ((stages.accelerate, speed[: begin + reach]), (stages.brake, speed[max(0, end - reach) :])):
        if ended is not None and (least := float(part.min())) > MOVES_ON * plateau:
            return f"the demand continues at {least:.4g} mm/s while the drive passes through rest"
    return None


def _format_time(window: Window, row: int) -> str:
    return f"{window.start_s + row * window.dt_s:.3f}"
