"""Replays a recorded move through the closed loop: the one comparison by which a model is weighed at the table."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdhil.config import Axis
from fdhil.identification.motion import resolution
from fdhil.identification.windows import moving_range
from fdhil.model import closed_loop, kernels
from fdhil.records import Float, Int, Parameters, Window, rms

LEAST_ROWS = 20
OFF_GRID = 1e-3  # of a cycle, by which a row may differ from it
STANDSTILL_S = 0.015  # over which the current before a move is taken
_EDGE = 8  # rows at either end that a shifted comparison leaves out


@dataclass(frozen=True, slots=True)
class Replay:
    """Where the model's table was at the SYNC instants (n,), mm, and the ``rows`` (m,) that can be compared.

    Of those: ``difference_um`` (m,), measured less predicted, and ``following_um`` (m,), measured less demanded.
    ``step_um`` is the measured position's resolution.
    """

    predicted_mm: Float
    rows: Int
    difference_um: Float
    following_um: Float
    step_um: float

    @property
    def unexplained_um(self) -> float:
        """RMS of what the model does not explain, without what the position's own steps make of any model."""
        return math.sqrt(max(0.0, rms(self.difference_um) ** 2 - self.step_um**2 / 12.0))

    @property
    def measured_um(self) -> float:
        """RMS of the measured following error."""
        return rms(self.following_um)


def replay(
    demand_mm: Float,
    position_mm: Float,
    parameters: Parameters,
    axis: Axis,
    sync_period_s: float,
    offset_mm: Float | None = None,
    standstill_a: float = 0.0,
) -> Replay:
    """Run a move from rest, rows (n,) on the SYNC grid, through the closed loop and compare it with the measured one.

    ``demand_mm`` is r[k], what the drive follows at row k; lost rows are NaN and not compared. ``standstill_a`` is what
    the regulators hold before the move. ValueError when fewer than ``LEAST_ROWS`` rows can be compared.
    """
    demand = _filled(demand_mm, "demand")
    offset = None if offset_mm is None else np.nan_to_num(offset_mm)
    start = _at_rest(float(_filled(position_mm, "position")[0]), standstill_a, parameters.R)
    predicted = closed_loop.simulate(parameters, axis, sync_period_s, demand, offset, state=start).position_mm
    rows = np.flatnonzero(np.isfinite(demand_mm) & np.isfinite(position_mm))
    rows = rows[(rows >= _EDGE) & (rows < demand.size - _EDGE)]
    if rows.size < LEAST_ROWS:
        raise ValueError(f"a move with {rows.size} whole rows is too short to judge the model")
    difference = (position_mm - predicted)[rows] * 1e3
    return Replay(
        predicted, rows, difference, (position_mm - demand_mm)[rows] * 1e3, 1e3 * resolution(position_mm[rows])
    )


def replay_window(window: Window, parameters: Parameters, axis: Axis, sync_period_s: float) -> Replay | None:
    """Return the replay of a window whose rows are the drive's set-points; None for any other.

    What a drive makes of its set-points between rows, or of those between two rows, is not recorded. None too where
    demand or position were not recorded, or did not move.
    """
    if abs(window.dt_s / sync_period_s - 1.0) > OFF_GRID or not (
        _moves(window.demand_mm) and _moves(window.position_mm)
    ):
        return None
    held, current = _holding(parameters, window.direction, _standstill_a(window))
    try:
        return replay(
            window.demand_mm, window.position_mm, held, axis, sync_period_s, window.offset_mm, standstill_a=current
        )
    except ValueError:  # too few whole rows, or no drive
        return None


def _at_rest(position_mm: float, current_a: float, resistance: float) -> closed_loop.State:
    """Return the state of an axis whose regulators hold a current against friction: both integrals make it."""
    state = closed_loop.start(position_mm)
    state[[kernels.CURRENT, kernels.CURRENT_DEMAND, kernels.SPEED_INTEGRAL]] = current_a
    state[kernels.CURRENT_INTEGRAL] = resistance * current_a
    return state


def _holding(p: Parameters, direction: int, current_a: float) -> tuple[Parameters, float]:
    """Return a drive that moves the same way in ``direction``, and rests under the current; and that current.

    The dry friction of one rapid holds a constant load, too: how much, it cannot tell, but the current before the move
    may. A drive with the friction Cd + D and a load D that helps the move goes as one with Cd does, and with D / K more
    current as one that has no load. Where even that does not hold the shaft, the model lacks friction at rest.
    """
    held, band = p.K * current_a - p.term("load"), p.Cd + max(p.term("stribeck"), 0.0)
    beyond = abs(held) - band
    if beyond <= 0.0:
        return p, current_a
    if held * direction > 0.0:
        return p, current_a - direction * beyond / p.K
    return p.changed(Cd=p.Cd + beyond / 2), current_a + direction * beyond / 2 / p.K


def _standstill_a(window: Window) -> float:
    """Return the current that the drive holds in the first rows of a window, which begins at rest."""
    rows = min(max(1, round(STANDSTILL_S / window.dt_s)), moving_range(window)[0])
    held = window.current_a[:rows]
    held = held[np.isfinite(held)]
    return float(held.mean()) if held.size else 0.0


def _moves(values: Float) -> bool:
    known = values[np.isfinite(values)]
    return bool(known.size and np.ptp(known) > 0.0)


def _filled(values: Float, what: str) -> Float:
    """Return the values with lost rows bridged: the demand is smooth, and what it drives there is not compared."""
    good = np.isfinite(values)
    if not good.any():
        raise ValueError(f"the move has no {what}")
    rows = np.arange(values.size)
    return np.asarray(np.interp(rows, rows[good], values[good]))
