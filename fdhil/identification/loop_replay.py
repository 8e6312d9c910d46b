"""Runs a rapid through the closed loop once more, from its recorded demand alone, and tells what is left of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from fdhil.config import Axis, Regulators
from fdhil.identification.windows import bridged, moving_range
from fdhil.model import closed_loop, kernels
from fdhil.records import Bool, Float, Parameters, Window, read_only, rms

LEAST_ROWS = 50
REST_ROWS = 20
EDGE_ROWS = 3  # at either end, where the demand may be cut
NIL_MM = 1e-9
PENALISED = 3  # order of the differences
WEIGHTS = tuple(10.0**k for k in range(6))
ROUNDED = 0.7  # of a step: half of one, and what the neighbours' rounding adds at a corner


@dataclass(frozen=True, slots=True)
class Rapid:
    """One rapid on its grid, rows (n,): what the drive was asked for, and what it did; ``known`` marks whole rows."""

    dt_s: float
    demand_mm: Float
    position_mm: Float
    current_a: Float
    known: Bool
    standstill_a: float
    moving: tuple[int, int]

    @property
    def lag_mm(self) -> Float:
        """The following error, demand less position."""
        return np.asarray(self.demand_mm - self.position_mm)

    @property
    def following_um(self) -> float:
        """RMS of the following error."""
        return rms(self.lag_mm[self.known]) * 1e3


def rapid_of(window: Window) -> Rapid | None:
    """Return the rapid of a window; None where demand, position and current are not all told."""
    known = np.isfinite(window.demand_mm) & np.isfinite(window.position_mm) & np.isfinite(window.current_a)
    known[:EDGE_ROWS] = known[-EDGE_ROWS:] = False
    if np.count_nonzero(known) < LEAST_ROWS:
        return None
    demand, position = bridged(window.demand_mm), bridged(window.position_mm)
    way = np.ptp(position)
    if way <= 0.0 or np.ptp(demand) < 0.5 * way or np.array_equal(demand, position):
        return None  # the demand was not recorded
    offset = 0.0 if window.offset_mm is None else np.nan_to_num(window.offset_mm)
    first = max(moving_range(window)[0], 1)
    current = bridged(window.current_a)
    return Rapid(
        window.dt_s,
        read_only(smoothed(demand) + offset),
        position,
        current,
        known,
        float(current[max(0, first - REST_ROWS) : first].mean()),
        moving_range(window),
    )


def smoothed(demand_mm: Float) -> Float:
    """Return the smoothest course (n,) that rounds to a recorded demand: what an NC plans is smooth, and finer.

    Rounded to 1 um at 1 kHz a demand asks for jumps of the speed by 1 mm/s, which the drive never saw. The squares of
    the third differences are weighed against the way from the record (Whittaker 1923), as far as rounding allows.
    """
    steps = np.abs(np.diff(demand_mm))
    steps = steps[steps > NIL_MM]
    course = demand_mm
    if demand_mm.size < 2 * PENALISED or not steps.size:
        return course
    for weight in WEIGHTS:
        trial = _whittaker(demand_mm, weight)
        if np.abs(trial - demand_mm).max() > ROUNDED * steps.min():
            break
        course = trial
    return course


def _whittaker(values: Float, weight: float) -> Float:
    """Return the course (n,) with the least squared way from ``values`` + ``weight`` x squared third differences."""
    n, third = values.size, np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((PENALISED + 1, n))
    for a in range(PENALISED + 1):
        for b in range(a, PENALISED + 1):
            bands[PENALISED - (b - a), b : n - PENALISED + b] += weight * third[a] * third[b]
    bands[PENALISED] += 1.0
    return np.asarray(solveh_banded(bands, values))


def replay(rapid: Rapid, parameters: Parameters, axis: Axis, delay_cycles: float) -> Float:
    """Return position in mm and current in A (2, n) of the closed loop along a rapid's demand.

    ``delay_cycles`` may lie between two whole numbers: it stands in the place of the regulators' own.
    """
    whole = math.floor(delay_cycles)
    part = delay_cycles - whole
    answer = _run(rapid, parameters, axis, whole)
    if part > 0.0:
        answer = (1.0 - part) * answer + part * _run(rapid, parameters, axis, whole + 1)
    return answer


def _run(rapid: Rapid, parameters: Parameters, axis: Axis, delay_cycles: int) -> Float:
    drive = with_regulators(axis, current_delay_cycles=delay_cycles)
    start = standing(float(np.median(rapid.position_mm[:EDGE_ROWS])), rapid.standstill_a, parameters)
    answer = closed_loop.simulate(parameters, drive, rapid.dt_s, rapid.demand_mm, state=start)
    return np.stack((answer.position_mm, answer.current_a))


def standing(position_mm: float, current_a: float, parameters: Parameters) -> closed_loop.State:
    """Return the state of an axis that stands and is held by a current: the integrals hold it."""
    state = closed_loop.start(position_mm)
    state[[kernels.CURRENT, kernels.SPEED_INTEGRAL, kernels.CURRENT_DEMAND]] = current_a
    state[kernels.CURRENT_INTEGRAL] = parameters.R * current_a
    return state


def with_regulators(axis: Axis, **values: float | str) -> Axis:
    """Return an axis with other regulators, unchecked: for those who try many."""
    return axis.model_copy(update={"regulators": axis.regulators.model_copy(update=values)})


def fitting_periods(regulators: Regulators, dt_s: float) -> dict[str, float]:
    """Return the cycles of speed and current loop that divide a row: the configured ones where they do."""
    speed = dt_s / max(1, round(dt_s / regulators.speed_period_s))
    current = speed / max(1, round(speed / regulators.current_period_s))
    return {"speed_period_s": speed, "current_period_s": current}
