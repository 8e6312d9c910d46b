"""Replays a recorded move through the closed loop: the one comparison by which a model is weighed at the table."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdhil.config import Axis
from fdhil.identification.motion import resolution
from fdhil.identification.windows import moving_range
from fdhil.model import closed_loop
from fdhil.model.terms import with_resonance
from fdhil.records import PARAMETERS, Float, Int, Parameters, Window, rms

LEAST_ROWS = 20
OFF_GRID = 1e-3  # of a cycle, by which a row may differ from it
SHARES_OF_LOAD = (0.0, -0.5, -0.25, -0.75, 0.5, 1.0, 2.0)  # of the friction in this direction, the likeliest first
ENOUGH = 0.02  # of the following error: left with less, no better share is looked for
STANDSTILL_S = 0.015  # over which the current before a move is taken
REST_S, LEAST_REST_S = 0.05, 0.02  # an axis at rest has stood so long: a deviation that still decays shows as motion
REST_MM, REST_STEPS = 3e-3, 2.5  # a position that changes by no more in REST_S, or by no more of its own steps, stands
_EDGE = 8  # rows at either end that a shifted comparison leaves out


@dataclass(frozen=True, slots=True)
class Replay:
    """The model's ``response`` at the SYNC instants (n,), and the ``rows`` (m,) that can be compared.

    Of those: ``difference_um`` (m,), measured less predicted, and ``following_um`` (m,), measured less demanded.
    ``step_um`` is the measured position's resolution.
    """

    response: closed_loop.Response
    rows: Int
    difference_um: Float
    following_um: Float
    step_um: float

    def during(self, begin: int, end: int) -> Replay:
        """Return the comparison of the rows from ``begin`` up to ``end`` alone, or of all where these are few."""
        kept = (self.rows >= begin) & (self.rows < end)
        if np.count_nonzero(kept) < LEAST_ROWS:
            return self
        return Replay(self.response, self.rows[kept], self.difference_um[kept], self.following_um[kept], self.step_um)

    @property
    def predicted_mm(self) -> Float:
        """Where the drive's encoder was at the SYNC instants (n,), as the model has it."""
        return self.response.position_mm

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
    standstill_a: float | None = None,
) -> Replay:
    """Run a move from rest, rows (n,) on the SYNC grid, through the closed loop and compare it with the measured one.

    A resonance that the axis' section tells of is the model's, as it is where it predicts.
    ``demand_mm`` is r[k], what the drive follows at row k; lost rows are NaN and not compared. ``standstill_a`` is what
    the regulators hold before the move (None: what they need). ValueError when fewer than ``LEAST_ROWS`` rows can be
    compared.
    """
    parameters = with_resonance(parameters, axis)
    demand = _filled(demand_mm, "demand")
    offset = None if offset_mm is None else np.nan_to_num(offset_mm)
    position = float(_filled(position_mm, "position")[0])
    start = closed_loop.standing(parameters, axis, position, standstill_a, float(demand[0]))
    response = closed_loop.simulate(parameters, axis, sync_period_s, demand, offset, state=start)
    rows = np.flatnonzero(np.isfinite(demand_mm) & np.isfinite(position_mm))
    rows = rows[(rows >= _EDGE) & (rows < demand.size - _EDGE)]
    if rows.size < LEAST_ROWS:
        raise ValueError(f"a move with {rows.size} whole rows is too short to judge the model")
    difference = (position_mm - response.position_mm)[rows] * 1e3
    return Replay(
        response, rows, difference, (position_mm - demand_mm)[rows] * 1e3, 1e3 * resolution(position_mm[rows])
    )


def replay_window(window: Window, parameters: Parameters, axis: Axis, sync_period_s: float) -> Replay | None:
    """Return the replay of a window whose rows are the drive's set-points; None for any other.

    What a drive makes of its set-points between rows, or of those between two rows, is not recorded. None too where
    demand or position were not recorded, or did not move. What is compared is the move: where within its friction the
    shaft comes to rest, one rapid does not tell. Its dry friction holds a constant load, too; how much of it is load
    shows as it leaves rest alone: of what it may be, that is taken which explains the rapid best.
    """
    if not _rows_are_setpoints(window, sync_period_s):
        return None
    signals, moving = (window.demand_mm, window.position_mm), moving_range(window)
    best: Replay | None = None
    for share in SHARES_OF_LOAD if not parameters.term("load") else (0.0,):
        parted = _parted(parameters, window.direction, _standstill_a(window), share)
        if parted is None:
            continue
        try:
            told = replay(*signals, parted[0], axis, sync_period_s, window.offset_mm, standstill_a=parted[1])
            told = told.during(*moving)
        except ValueError:  # too few whole rows, or no drive
            return None
        best = told if best is None or told.unexplained_um < best.unexplained_um else best
        if best.unexplained_um < ENOUGH * best.measured_um:
            break
    return best


def replay_setpoints(window: Window, parameters: Parameters, axis: Axis, sync_period_s: float) -> Replay | None:
    """Return the replay of a window as :func:`replay_window`, by this very model: nothing is fitted to it.

    None too where the axis had not come to rest before: what its regulators held then is not recorded.
    """
    begin = moving_range(window)[0]
    rest = slice(max(0, begin - math.ceil(REST_S / window.dt_s)), begin)
    if not _rows_are_setpoints(window, sync_period_s) or not _stands(window, rest):
        return None
    parameters = completed(parameters, Parameters(**axis.nominal.model_dump()))
    # before the rest the axis may still settle from the move before
    signals = [
        np.concatenate([np.full(rest.start, np.nan), values[rest.start :]])
        for values in (window.demand_mm, window.position_mm)
    ]
    held_a = _mean(window.current_a[rest][: round(STANDSTILL_S / window.dt_s)])
    try:
        told = replay(*signals, parameters, axis, sync_period_s, window.offset_mm, standstill_a=held_a)
    except ValueError:  # too few whole rows, or no drive
        return None
    return told.during(*moving_range(window)) if np.isfinite(told.difference_um).all() else None


def completed(parameters: Parameters, spare: Parameters) -> Parameters:
    """Return the parameters with what is not known of them taken from ``spare``: R and L do little at the table."""
    values = parameters.as_dict()
    return parameters.changed(
        **{name: getattr(spare, name) for name in PARAMETERS[:2] if not math.isfinite(values[name])}
    )


def _rows_are_setpoints(window: Window, sync_period_s: float) -> bool:
    """Return whether a window's rows are the drive's set-points, and demand and position were recorded and moved."""
    on_grid = abs(window.dt_s / sync_period_s - 1.0) <= OFF_GRID
    return on_grid and _moves(window.demand_mm) and _moves(window.position_mm)


def _parted(p: Parameters, direction: int, current_a: float, share: float) -> tuple[Parameters, float] | None:
    """Return a drive that moves the same way in ``direction`` with a load, and the current that it holds at rest.

    With the friction Cd + D and a load D that helps the move it goes as with Cd. D is ``share`` of Cd, at least what
    holds the shaft under the current; None where that is no share of this sign. Where no load holds it, it has friction
    at rest that the model lacks, and the current is what the model holds.
    """
    helping = share * p.Cd
    held, rests = direction * (p.K * current_a - p.term("load")), max(p.term("stribeck"), 0.0)
    least = (-held - p.Cd - rests) / 2.0
    if share == 0.0:
        helping = max(0.0, least, -p.Cd)  # a load that helps may be more than friction: then their sum is below 0
    elif share < 0.0:
        helping = max(helping, least, -p.Cd)  # so much of it as holds the shaft
        if helping >= 0.0:
            return None
    most = p.Cd + rests  # held less what the load takes is at most the friction at rest
    current = current_a - direction * max(0.0, held - most) / p.K
    if helping == 0.0:
        return p, current
    return p.changed(Cd=p.Cd + helping, load=p.term("load") - direction * helping), current


def _stands(window: Window, rest: slice) -> bool:
    """Return whether the axis stands in these rows, but for steps and noise of its position."""
    position, lasts_s = window.position_mm[rest], (rest.stop - rest.start) * window.dt_s
    position = position[np.isfinite(position)]
    limit_mm = max(REST_MM * lasts_s / REST_S, REST_STEPS * resolution(window.position_mm))
    return lasts_s >= LEAST_REST_S and position.size > 0 and float(np.ptp(position)) <= limit_mm


def _standstill_a(window: Window) -> float:
    """Return the current that the drive holds in the first rows of a window, which begins at rest."""
    rows = min(max(1, round(STANDSTILL_S / window.dt_s)), moving_range(window)[0])
    return _mean(window.current_a[:rows])


def _mean(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else 0.0


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
