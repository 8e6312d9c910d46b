"""Replays a recorded move through the closed loop: the one comparison by which a model is assessed at the table."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdhil.config import Axis
from fdhil.identification import find_moving_range, find_resolution
from fdhil.model import Response, add_resonance, create_standstill_state, simulate_axis
from fdhil.records import PARAMETERS, Float, Int, Parameters, Window, compute_rms

LEAST_ROWS = 20
OFF_GRID = 1e-3  # of a cycle, by which a row may differ from it
SHARES_OF_LOAD = (0.0, -0.5, -0.25, -0.75, 0.5, 1.0, 2.0)  # of the friction in this direction, the likeliest first
ENOUGH = 0.02  # of the following error: below, no better share is searched for
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

    response: Response
    rows: Int
    difference_um: Float
    following_um: Float
    step_um: float

    def select_samples(self, begin: int, end: int) -> Replay:
        """Return the comparison of the rows from ``begin`` up to ``end`` alone, or of all where these are few."""
        kept = (self.rows >= begin) & (self.rows < end)
        if np.count_nonzero(kept) < LEAST_ROWS:
            return self
        return Replay(self.response, self.rows[kept], self.difference_um[kept], self.following_um[kept], self.step_um)

    @property
    def predicted_mm(self) -> Float:
        """The predicted position of the drive's encoder at the SYNC instants (n,)."""
        return self.response.position_mm

    @property
    def unexplained_um(self) -> float:
        """RMS difference that the model does not explain, less the effect of the position's resolution."""
        return math.sqrt(max(0.0, compute_rms(self.difference_um) ** 2 - self.step_um**2 / 12.0))

    @property
    def measured_um(self) -> float:
        """RMS of the measured following error."""
        return compute_rms(self.following_um)


def replay_move(
    demand_mm: Float,
    position_mm: Float,
    parameters: Parameters,
    axis: Axis,
    sync_period_s: float,
    offset_mm: Float | None = None,
    standstill_a: float | None = None,
) -> Replay:
    """Simulate a move from rest, rows (n,) on the SYNC grid, in the closed loop and compare it with the measured one.

    A resonance in the axis' section is part of the model, as it is in predictions. ``demand_mm`` is r[k], which the
    drive follows at row k; lost rows are NaN and not compared. ``standstill_a`` is the current that the regulators hold
    before the move (None: what they need). ValueError when fewer than ``LEAST_ROWS`` rows can be compared.
    """
    parameters = add_resonance(parameters, axis)
    demand = _fill_gaps(demand_mm, "demand")
    offset = None if offset_mm is None else np.nan_to_num(offset_mm)
    position = float(_fill_gaps(position_mm, "position")[0])
    start = create_standstill_state(parameters, axis, position, standstill_a, float(demand[0]))
    response = simulate_axis(parameters, axis, sync_period_s, demand, offset, state=start)
    rows = np.flatnonzero(np.isfinite(demand_mm) & np.isfinite(position_mm))
    rows = rows[(rows >= _EDGE) & (rows < demand.size - _EDGE)]
    if rows.size < LEAST_ROWS:
        raise ValueError(f"a move with {rows.size} whole rows is too short to assess the model")
    difference = (position_mm - response.position_mm)[rows] * 1e3
    return Replay(
        response, rows, difference, (position_mm - demand_mm)[rows] * 1e3, 1e3 * find_resolution(position_mm[rows])
    )


def replay_with_load_search(window: Window, parameters: Parameters, axis: Axis, sync_period_s: float) -> Replay | None:
    """Return the replay of a window whose rows are the drive's set-points; None for any other.

    The drive's response between rows is not recorded. None too where demand or position were not recorded, or did not
    move. The move alone is compared: the position at which the shaft rests within its friction cannot be predicted from
    one rapid. Dry friction holds a constant load, too; its share shows only at the start of the move: the share that
    explains the rapid best is used.
    """
    if not _has_setpoint_samples(window, sync_period_s):
        return None
    signals, moving = (window.demand_mm, window.position_mm), find_moving_range(window)
    best: Replay | None = None
    for share in SHARES_OF_LOAD if not parameters.get_term("load") else (0.0,):
        parted = _split_friction_and_load(parameters, window.direction, _measure_holding_current_a(window), share)
        if parted is None:
            continue
        try:
            replayed = replay_move(*signals, parted[0], axis, sync_period_s, window.offset_mm, standstill_a=parted[1])
            replayed = replayed.select_samples(*moving)
        except ValueError:  # too few complete rows, or no valid drive
            return None
        best = replayed if best is None or replayed.unexplained_um < best.unexplained_um else best
        if best.unexplained_um < ENOUGH * best.measured_um:
            break
    return best


def replay_setpoints(window: Window, parameters: Parameters, axis: Axis, sync_period_s: float) -> Replay | None:
    """Return the replay of a window of set-points by this very model: no share of load is fitted.

    None too where the axis had not come to rest before: its regulators' state then is not recorded.
    """
    begin = find_moving_range(window)[0]
    rest = slice(max(0, begin - math.ceil(REST_S / window.dt_s)), begin)
    if not _has_setpoint_samples(window, sync_period_s) or not _stands(window, rest):
        return None
    parameters = fill_missing_winding(parameters, Parameters(**axis.nominal.model_dump()))
    # before the rest the axis may still settle from the move before
    demand_mm, position_mm = (
        np.concatenate([np.full(rest.start, np.nan), values[rest.start :]])
        for values in (window.demand_mm, window.position_mm)
    )
    held_a = _mean(window.current_a[rest][: round(STANDSTILL_S / window.dt_s)])
    try:
        replayed = replay_move(
            demand_mm, position_mm, parameters, axis, sync_period_s, window.offset_mm, standstill_a=held_a
        )
    except ValueError:  # too few complete rows, or no valid drive
        return None
    return replayed.select_samples(*find_moving_range(window)) if np.isfinite(replayed.difference_um).all() else None


def fill_missing_winding(parameters: Parameters, spare: Parameters) -> Parameters:
    """Return the parameters with unknown R and L taken from ``spare``: they have little effect at the table."""
    values = parameters.as_dict()
    return parameters.replace_values(
        **{name: getattr(spare, name) for name in PARAMETERS[:2] if not math.isfinite(values[name])}
    )


def _has_setpoint_samples(window: Window, sync_period_s: float) -> bool:
    on_grid = abs(window.dt_s / sync_period_s - 1.0) <= OFF_GRID
    return on_grid and _has_motion(window.demand_mm) and _has_motion(window.position_mm)


def _split_friction_and_load(
    p: Parameters, direction: int, current_a: float, share: float
) -> tuple[Parameters, float] | None:
    """Return a drive that moves the same way in ``direction`` with a load, and the current that it holds at rest.

    With the friction Cd + D and a load D that helps the move it moves as with Cd. D is ``share`` of Cd, at least what
    holds the shaft under the current; None where no share of this sign does. Where no load holds it, it has friction at
    rest that the model lacks, and the current is what the model holds.
    """
    helping = share * p.Cd
    held, rests = direction * (p.K * current_a - p.get_term("load")), max(p.get_term("stribeck"), 0.0)
    least = (-held - p.Cd - rests) / 2.0
    if share == 0.0:
        helping = max(0.0, least, -p.Cd)  # a load that helps may be more than friction: then their sum is below 0
    elif share < 0.0:
        helping = max(helping, least, -p.Cd)  # as much as holds the shaft
        if helping >= 0.0:
            return None
    most = p.Cd + rests  # the holding torque less the load's share is at most the friction at rest
    current = current_a - direction * max(0.0, held - most) / p.K
    if helping == 0.0:
        return p, current
    return p.replace_values(Cd=p.Cd + helping, load=p.get_term("load") - direction * helping), current


def _stands(window: Window, rest: slice) -> bool:
    """Return whether the axis stands in these rows, but for steps and noise of its position."""
    position, lasts_s = window.position_mm[rest], (rest.stop - rest.start) * window.dt_s
    position = position[np.isfinite(position)]
    limit_mm = max(REST_MM * lasts_s / REST_S, REST_STEPS * find_resolution(window.position_mm))
    return lasts_s >= LEAST_REST_S and position.size > 0 and float(np.ptp(position)) <= limit_mm


def _measure_holding_current_a(window: Window) -> float:
    """Return the current that the drive holds in the first rows of a window, which begins at rest."""
    rows = min(max(1, round(STANDSTILL_S / window.dt_s)), find_moving_range(window)[0])
    return _mean(window.current_a[:rows])


def _mean(values: Float) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else 0.0


def _has_motion(values: Float) -> bool:
    known = values[np.isfinite(values)]
    return bool(known.size and np.ptp(known) > 0.0)


def _fill_gaps(values: Float, what: str) -> Float:
    """Return the values with lost rows interpolated: the demand is smooth, and its effect there is not compared."""
    good = np.isfinite(values)
    if not good.any():
        raise ValueError(f"the move has no {what}")
    rows = np.arange(values.size)
    return np.asarray(np.interp(rows, rows[good], values[good]))
