"""Solves one block of one axis: offsets, in whole increments and within their limits, that keep it on its target.

The offset is improved by iteration: simulate the closed loop with it, pass the remaining error through the inverse of
the linear loop, add. Two things are not left to the iteration. The limits hold at every step. And where the axis rests,
the speed loop's integral would wind up and the table slip by micrometres now and then: there the offset leads the
current to the middle of the dry friction's band and keeps the position loop at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.correction.linear_loop import LoopInverse
from fdhil.correction.plan_limits import PlanLimits, check_offsets, fit_within_limits
from fdhil.correction.stiction_hold import StictionHold, run_with_offset
from fdhil.model import SPEED, TABLE_SPEED, PreparedDrive, Response, State
from fdhil.records import Bool, Float, Parameters

ITERATIONS = 8
GOOD_ENOUGH_UM, PEAK_UM = 0.05, 0.15  # RMS and largest: below the drive's increments (0.3 um)
PEAK_SHARE = 0.3
LEAST_PROGRESS = 0.85  # of the best residual so far; two iterations that leave more end the search
STILL_MM_S = 1e-3
SHORTEST_REST_S = 0.03
LEAD_S = 0.02  # before an axis starts again the offset is free
STUCK_UM = 1.5  # a table that rests farther from its target is moved, not held
SEARCH_S = 0.15
BAND = 0.97  # of the dry friction: safely held
FADE_S = 0.04
FORGET_S = 0.05


@dataclass(frozen=True, slots=True)
class AxisLoop:
    """One axis with its inverse."""

    parameters: Parameters
    axis: Axis
    sync_period_s: float
    limits: PlanLimits
    drive: PreparedDrive
    inverse: LoopInverse
    resting: StictionHold

    @property
    def increment_mm(self) -> float:
        """Millimetres per drive increment."""
        return self.limits.um_per_increment * 1e-3

    def simulate_rows(self, reference_mm: Float, offset: Float, state: State, first: int, stop: int) -> Response:
        """Run rows ``first`` .. ``stop`` of a block with an offset in increments."""
        return run_with_offset(self.drive, reference_mm[first:], offset[first:], self.increment_mm, state, stop - first)


@dataclass(frozen=True, slots=True)
class BlockState:
    """The state for the next block: the drive's state at its first row, two fixed increments, a guess.

    ``fixed`` (2,): offsets of the next block's first two rows, which the last cycles have already used. ``guess`` (m,):
    unrounded offsets of the look-ahead rows.
    """

    state: State
    fixed: Float
    guess: Float


@dataclass(frozen=True, slots=True)
class BlockSolution:
    """A block's ``offset`` (n,) in increments, the resulting position (n,) in mm, and the unrounded guess.

    ``rms_um`` is the residual; ``needed_um`` the largest offset that the linear loop needs, in row ``needed_at``: if it
    exceeds the limit, the block was not solved.
    """

    offset: Float
    position_mm: Float
    guess: Float
    rms_um: float
    needed_um: float
    needed_at: int = 0


def find_rests(reference_mm: Float, target_mm: Float, sync_period_s: float, ends: bool) -> list[tuple[int, int]]:
    """Return half-open ranges of rows in which reference and target stand still for long enough.

    ``ends``: the reference ends here, so no start follows the last rest.
    """
    limit = STILL_MM_S * sync_period_s
    still = (np.abs(np.diff(reference_mm, append=reference_mm[-1])) <= limit) & (
        np.abs(np.diff(target_mm, append=target_mm[-1])) <= limit
    )
    still &= np.abs(reference_mm - target_mm) <= limit
    if not ends:
        still[-1] = False
    edges = np.flatnonzero(np.diff(still.astype(np.int8), prepend=0, append=0))
    found = []
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        stop = last if last == still.size else last - round(LEAD_S / sync_period_s)
        if (stop - first) * sync_period_s > SHORTEST_REST_S:
            found.append((first, stop))
    return found


def solve_block(loop: AxisLoop, reference_mm: Float, target_mm: Float, carry: BlockState, ends: bool) -> BlockSolution:
    """Find the offsets of a block whose first two rows are fixed; ``ends`` when nothing follows it."""
    n = reference_mm.size
    still = find_rests(reference_mm, target_mm, loop.sync_period_s, ends)
    guess = np.zeros(n)
    known = min(n, carry.guess.size)
    guess[:known] = carry.guess[:known]
    if 0 < known < n:
        guess[known:] = carry.guess[known - 1] * _make_fade_out(n - known, loop.sync_period_s)
    best: BlockSolution | None = None
    gain = 1.0
    needed_um = 0.0
    idle = 0
    best_worth = np.inf
    for iteration in range(ITERATIONS + 1):
        offset, position, error = _simulate_guess(
            loop, reference_mm, target_mm, guess, carry, still, lead=iteration > 0
        )
        unknown = 0 if ends else round(FORGET_S / loop.sync_period_s)  # later rows would change these
        error[n - unknown :] = 0.0
        left_um = 1e3 * (target_mm - position)[: max(1, n - unknown)]
        rms_um = float(np.sqrt(np.mean(left_um**2)))
        idle = 0 if best is None or rms_um < LEAST_PROGRESS * best.rms_um else idle + 1
        peak_um = float(np.abs(left_um).max())
        worth = rms_um + PEAK_SHARE * peak_um  # a slip of the table hardly shows in the RMS
        if best is None or worth < best_worth:
            best_worth = worth
            best = BlockSolution(offset, position, guess, rms_um, needed_um)
        if (rms_um < GOOD_ENOUGH_UM and peak_um < PEAK_UM) or idle == 2:
            break
        if rms_um > 2.0 * best.rms_um:  # a step too far: half of it, from where it was good
            gain *= 0.5
            guess = best.guess
            continue
        guess = guess + gain * loop.inverse.compute_offset(error) / loop.increment_mm
        if iteration == 0:  # before the limits act, the linear loop gives the offset that the path needs
            needed_um = float(np.abs(guess).max()) * loop.limits.um_per_increment
            if needed_um > loop.limits.offset * loop.limits.um_per_increment:
                return replace(best, needed_um=needed_um, needed_at=int(np.argmax(np.abs(guess))))
    assert best is not None
    return replace(best, needed_um=needed_um)


def _simulate_guess(
    loop: AxisLoop,
    reference_mm: Float,
    target_mm: Float,
    guess: Float,
    carry: BlockState,
    still: list[tuple[int, int]],
    *,
    lead: bool,
) -> tuple[Float, Float, Float]:
    """Simulate with the guess inside its limits; return offset (increments), position, and the error to work on.

    ``lead``: the offsets at rest lead the current to rest; the first iteration does without.
    """
    offset = np.empty(guess.size)
    offset[:2] = carry.fixed[: offset.size]
    before = (float(offset[min(1, offset.size - 1)]), float(offset[0]))
    guess[2:] = fit_within_limits(
        guess[2:], loop.limits, before
    )  # kept within the limits: else the guess would wind up
    offset[2:] = np.rint(guess[2:])
    position = np.empty(guess.size)
    error_of_rest = np.zeros(guess.size)
    held = np.zeros(guess.size, dtype=np.bool_)
    state, done = carry.state, 0
    for first, stop in still:
        if stop <= done:
            continue
        # dry friction takes hold early in a rest or not at all
        look = min(stop, max(first, done) + round(SEARCH_S / loop.sync_period_s))
        response = loop.simulate_rows(reference_mm, offset, state, done, look)
        position[done:look] = response.table_mm
        stuck = _find_stuck_row(loop, response, target_mm[done:look], max(first - done, 0))
        if stuck is None:
            state, done = response.end, look
            continue
        row = done + stuck
        state = response.extract_state(stuck)
        if lead:
            _write_hold_offset(loop, reference_mm, offset, state, row, stop)
        response = loop.simulate_rows(reference_mm, offset, state, row, stop)
        position[row:stop], state, done = response.table_mm, response.end, stop
        held[row:stop] = True
        gone = np.maximum(0.0, 1 - np.arange(stop - row) * loop.sync_period_s / FORGET_S)
        error_of_rest[row:stop] = (target_mm[row] - position[row]) * gone
    if done < guess.size:
        position[done:] = loop.simulate_rows(reference_mm, offset, state, done, guess.size).table_mm
    if held.any() and check_offsets(offset[2:].astype(np.int64), loop.limits, before):
        offset[2:] = np.rint(fit_within_limits(offset[2:], loop.limits, before))
        position = loop.simulate_rows(reference_mm, offset, carry.state, 0, guess.size).table_mm
    return offset, position, np.where(held, error_of_rest, target_mm - position)


def _find_stuck_row(loop: AxisLoop, response: Response, target_mm: Float, first: int) -> int | None:
    """Return the first row from ``first`` on at which dry friction holds the table near its target."""
    band = loop.resting.compute_band_at(float(target_mm[first]))
    near: Bool = (
        (response.states[TABLE_SPEED if response.has_separate_table else SPEED] == 0.0)
        & band.is_holding(loop.parameters.K * response.current_a, BAND)
        & (np.abs(response.table_mm - target_mm) <= STUCK_UM * 1e-3)
    )
    rows = np.flatnonzero(near[first:])
    return first + int(rows[0]) if rows.size else None


def _write_hold_offset(loop: AxisLoop, reference_mm: Float, offset: Float, state: State, row: int, stop: int) -> None:
    """Write the offset of a rest from ``row`` + 2 on, and fade out its difference from the guess after it."""
    if stop - row < 3:
        return
    n = offset.size
    planned_end = offset[stop - 1]
    offset[row:stop] = loop.resting.compute_hold_offset(reference_mm[row:stop], offset[row : row + 2].copy(), state)
    if stop < n:
        change = (offset[stop - 1] - planned_end) * _make_fade_out(n - stop, loop.sync_period_s)
        offset[stop:] = np.rint(offset[stop:] + change)


def _make_fade_out(rows: int, sync_period_s: float) -> Float:
    share = np.minimum(np.arange(1, min(rows, int(np.ceil(FADE_S / sync_period_s))) + 1) * sync_period_s / FADE_S, 1.0)
    factor = np.zeros(rows)
    factor[: share.size] = 0.5 * (1 + np.cos(np.pi * share))
    return factor
