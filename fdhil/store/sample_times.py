"""Recovers the even grid of sample times with low resolution or jitter, if it is unambiguous."""

import numpy as np

from fdhil.errors import RecordingError
from fdhil.records import Float, Int
from fdhil.store.recording_table import STEP_TOLERANCE

FIT = 1.1  # of the rounding: largest deviation from an even grid
MULTIPLE = 0.05  # of the rounding: largest deviation of a step from a multiple
FEW = 4  # deviating steps that may be lost samples of an even grid
MANY = 0.05  # of the steps: more deviate by jitter, fewer by pauses of the recording
LEAST_SPANS = 20  # of the rounding: span that determines the period to a percent


def find_even_times(time_s: Float, rate_hz: float | None, source: str) -> tuple[Float, str]:
    """Return the times (n,), or the even grid that they approximate, and what was done ("" if nothing).

    Raises RecordingError if steps may be rounded or jittered times as well as lost or uneven samples; ``rate_hz``
    decides.
    """
    found_s, note = _undo_rounding(time_s, rate_hz, source)
    return (found_s, note) if note else _remove_jitter(found_s, rate_hz, source)


def _remove_jitter(time_s: Float, rate_hz: float | None, source: str) -> tuple[Float, str]:
    """Return the grid of the rate if many steps are neither usual nor a multiple, as with time stamps."""
    steps = np.diff(time_s)
    usual = float(np.median(steps)) if rate_hz is None else 1 / rate_hz
    if steps.size < FEW or not usual > 0 or (steps <= 0).any():
        return time_s, ""
    counts = np.maximum(np.rint(steps / usual), 1)
    is_off = np.abs(steps - counts * usual) > STEP_TOLERANCE * steps
    if is_off.sum() <= max(FEW, MANY * steps.size):
        return time_s, ""
    shown = f"steps of time vary from {steps.min():.3g} to {steps.max():.3g} s"
    if rate_hz is None:
        raise RecordingError(
            f"{source}: {shown}: for even samples with jittered time stamps give sample_rate_hz under "
            "[headers] of the column map; uneven samples must be recorded with a fixed step"
        )
    rows = np.concatenate([[0], np.cumsum(counts)])
    drift_s = (time_s - time_s[0]) - rows * usual
    if np.ptp(drift_s) > usual:
        raise RecordingError(
            f"{source}: {shown}and drift from {rate_hz:g} Hz by {np.ptp(drift_s):.3g} s: correct sample_rate_hz, "
            "or record with a fixed step"
        )
    return time_s[0] + rows * usual, f"{shown}; a sample period of {usual:.6g} s is used"


def _undo_rounding(time_s: Float, rate_hz: float | None, source: str) -> tuple[Float, str]:
    steps = np.diff(time_s)
    rounding_s = _find_rounding(steps)
    if steps.size < FEW or rounding_s is None or (steps < 0).any():
        return time_s, ""
    usual = float(np.median(steps)) if rate_hz is None else 1 / rate_hz
    off = np.abs(steps - usual) > STEP_TOLERANCE * usual
    is_loss = usual > 0 and _are_multiples(steps[off], usual)
    if not off.any() or (off.sum() < FEW and (is_loss or not steps[off].all())):
        return time_s, ""
    grid = _fit_grid(time_s, np.arange(time_s.size), rounding_s, rate_hz)
    is_short = rate_hz is None and time_s[-1] - time_s[0] < LEAST_SPANS * rounding_s
    if usual == 0 and (grid is None or is_short):
        raise RecordingError(
            f"{source}: times are written to {rounding_s:g} s, too coarse for the sample period: give "
            "sample_rate_hz under [headers] of the column map"
        )
    if grid is None or is_short:
        return (time_s, "") if is_loss else _find_grid_with_gaps(time_s, steps, rounding_s, rate_hz)
    period_s = float(grid[-1] - grid[0]) / steps.size
    if is_loss and rate_hz is None:
        raise RecordingError(
            f"{source}: {off.sum()} of {steps.size} steps of time are a multiple of {usual:g} s: either samples "
            f"{period_s:.6g} s apart with times rounded to {rounding_s:g} s, or samples {usual:g} s apart of "
            "which some are lost; give sample_rate_hz under [headers] of the column map"
        )
    return grid, _format_note(period_s, rounding_s)


def compute_usual_step(time_s: Float) -> float:
    """Return the mean of the steps that are as long as most, s; their median if none are."""
    steps = np.diff(time_s)
    usual = np.median(steps)
    similar = steps[np.abs(steps - usual) <= STEP_TOLERANCE * abs(usual)]
    return float(similar.mean() if similar.size else usual)


def _find_grid_with_gaps(time_s: Float, steps: Float, rounding_s: float, rate_hz: float | None) -> tuple[Float, str]:
    """Return the even grid with rows left out for lost samples; the times unchanged if they are on no grid."""
    near = steps[steps < 1.5 * np.median(steps)]
    if not near.size or rounding_s > near.mean() / 2:
        return time_s, ""
    rows = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / near.mean()), 1))]).astype(np.int64)
    grid = _fit_grid(time_s, rows, rounding_s, rate_hz)
    return (time_s, "") if grid is None else (grid, _format_note(float((grid[-1] - grid[0]) / rows[-1]), rounding_s))


def _format_note(period_s: float, rounding_s: float) -> str:
    return f"times are rounded to {rounding_s:.4g} s; a sample period of {period_s:.6g} s is used"


def _find_rounding(steps: Float) -> float | None:
    """Return the least difference between distinct steps if all steps are multiples of it."""
    distinct = np.unique(np.round(steps, 9))
    least = float(np.diff(distinct).min()) if distinct.size > 1 else 0.0
    if least < 2e-9 or np.abs(distinct / least - np.rint(distinct / least)).max() > MULTIPLE:
        return None
    return least


def _are_multiples(steps: Float, usual: float) -> bool:
    """Return whether each step is two usual ones or more, as lost samples leave it."""
    counts = np.rint(steps / usual)
    return bool(((counts >= 2) & (np.abs(steps - counts * usual) <= STEP_TOLERANCE * steps)).all())


def _fit_grid(time_s: Float, rows: Int, rounding_s: float, rate_hz: float | None) -> Float | None:
    middle, about = rows - rows.mean(), time_s - time_s.mean()
    period_s = float(middle @ about / (middle @ middle)) if rate_hz is None else 1 / rate_hz
    if np.ptp(about - period_s * middle) > FIT * rounding_s:
        return None
    even: Float = time_s[0] + period_s * (rows - rows[0])
    return even
