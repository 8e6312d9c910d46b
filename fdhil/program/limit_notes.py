"""Compare a recorded demand with the limits of its NC: speed and acceleration of each axis, and path speed.

A demand in increments has steps: differences are taken over as many rows as keep their rounding below a share of the
limit. Pure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from fdhil.config import MachineConfig, is_second_drive
from fdhil.records import Float, Reason, Trajectory

ROOM = 1.05  # tolerance factor on a limit
ROUNDING_SHARE = 0.02  # largest share of a limit due to rounding of the demand


def find_limit_violations(demand: Trajectory, config: MachineConfig) -> tuple[Reason, ...]:
    """Return where a demand exceeds the limits of an NC that plans within them; none for profile ``fir``."""
    if config.nc.profile == "fir":
        return ()
    return tuple(_find_exceeded_limits(demand, config))


def _find_exceeded_limits(demand: Trajectory, config: MachineConfig) -> Iterator[Reason]:
    speeds = []
    for name, axis in config.axis.items():
        position, step = demand.position_mm[name], _find_resolution_mm(demand.position_mm[name])
        speed = _differentiate_with_rounding(_compute_speed, position, demand.dt_s, axis.rapid_speed_mm_s, step)
        acceleration = _differentiate_with_rounding(
            _compute_acceleration, position, demand.dt_s, axis.max_acceleration_mm_s2, step
        )
        if axis.unit == "mm" and not is_second_drive(name):
            speeds.append(speed)
        unit = axis.mm_per_unit
        for what, found, per, key in (
            ("moves at", speed, "s", "rapid_speed_mm_s"),
            ("accelerates by", acceleration, "s2", "max_acceleration_mm_s2"),
        ):
            text, limit = f"axis {name} {what}", getattr(axis, key) / unit
            shown = f"axis.{name}.{axis.format_key(key)}"
            yield from _report_exceeded_limit(demand, found / unit, limit, text, f"{axis.unit}/{per}", shown)
    if not speeds:
        return
    along, limit = np.sqrt(np.sum(np.square(speeds), axis=0)), config.nc.max_path_speed_mm_s
    yield from _report_exceeded_limit(demand, along, limit, "the path speed is", "mm/s", "nc.max_path_speed_mm_s")


def _report_exceeded_limit(
    demand: Trajectory, found: Float, limit: float, what: str, unit: str, key: str
) -> Iterator[Reason]:
    row = int(np.argmax(found))
    if found[row] <= ROOM * limit:
        return
    line = f"line {demand.line[row]}, " if demand.line[row] else ""
    place = f"{line}{demand.time_s[row]:.3f} s, {demand.describe_position(row)}"
    text = f"{what} {found[row]:.4g} {unit} at {place}: the limit of {key} is {limit:.4g}"
    advice = f"correct {key} if the NC has another limit; else its planner exceeds it, as S-curve planners do in blends"
    yield Reason("DemandBeyondLimits", text, advice)


def _find_resolution_mm(position_mm: Float) -> float:
    steps = np.abs(np.diff(position_mm))
    steps = steps[steps > 1e-9]
    return float(steps.min()) if steps.size else 0.0


def _differentiate_with_rounding(
    of: Callable[[Float, int, float], tuple[Float, float]], position: Float, dt_s: float, limit: float, step: float
) -> Float:
    """Return a derivative (n,) over as few rows as its rounding allows."""
    rows = 1
    while of(position, rows, dt_s)[1] * step > ROUNDING_SHARE * limit and rows < position.size // 8:
        rows *= 2
    return of(position, rows, dt_s)[0]


def _compute_speed(position: Float, rows: int, dt_s: float) -> tuple[Float, float]:
    """Return the absolute speed (n,) over ``rows``, and the effect of a rounding of 1 mm at both ends."""
    span_s = rows * dt_s
    return _pad_to_rows(np.abs(position[rows:] - position[:-rows]) / span_s, position.size), 1.0 / span_s


def _compute_acceleration(position: Float, rows: int, dt_s: float) -> tuple[Float, float]:
    """Return the absolute acceleration (n,) over ``rows`` to either side, and the effect of roundings of 1 mm."""
    span_s = rows * dt_s
    bend = np.abs(position[2 * rows :] - 2.0 * position[rows:-rows] + position[: -2 * rows])
    return _pad_to_rows(bend / span_s**2, position.size), 2.0 / span_s**2


def _pad_to_rows(found: Float, rows: int) -> Float:
    """Return (rows,) values centred on their rows, 0 at the ends, where a recording may begin or end in motion."""
    before = (rows - found.size) // 2
    return np.pad(found, (before, rows - found.size - before))
