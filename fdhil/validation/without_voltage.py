"""Checks what current and position alone tell: a late current, a load that comes and goes, torque left unexplained."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fdhil.identification.normal import inverse_gram
from fdhil.identification.without_voltage import candidates, effective_rows, late_s
from fdhil.records import Reason, rms
from fdhil.validation.evidence import Evidence
from fdhil.validation.significance import BUDGET

EDGES = 20  # instants at which a load may begin or end
LEAST_LOAD = 0.05  # of the peak current: a screw's friction differs from place to place by less
LARGEST_SHARE = 0.10  # of the torque's RMS that the model may leave unexplained: more, and it is no model of this drive
LATE_ROWS = 1.0
IMITATED = 1e-6  # of a course's power, below which only rounding is left of it


def torque_late(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason where the current is late or early against the motion by surely more than a row."""
    if evidence.torque is None:
        return
    late, std = late_s(evidence.torque)
    dt = evidence.window.dt_s
    if abs(late) > LATE_ROWS * dt + BUDGET["timing"].deviations * std:
        side = "late" if late > 0 else "early"
        text = f"current is {1e3 * abs(late):.2f} ms {side} against the motion, more than a row of {1e3 * dt:.3g} ms"
        yield Reason("SampleTiming", text, "take current, speed and position from one SYNC")


def load_comes_and_goes(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason where a torque acts over a part of the move that neither the model nor friction explains."""
    fitted = evidence.torque
    if fitted is None:
        return
    # what friction at low speed, or a ripple, may be is no load, whether it was worth joining or not
    others = [term.columns for term in candidates(fitted)]
    design = np.column_stack([fitted.design, *others])
    inverse, _ = inverse_gram(design)
    left = fitted.current - design @ (inverse @ (design.T @ fitted.current))
    edges = np.linspace(0, left.size, EDGES + 1).astype(int)
    starts, ends = np.triu_indices(EDGES + 1, 1)
    steps = (np.arange(left.size)[:, None] < edges[None, :]).astype(np.float64)
    blocks = steps[:, ends] - steps[:, starts]
    beyond = blocks - design @ (inverse @ (design.T @ blocks))
    power = np.square(beyond).sum(axis=0)
    seen = power > IMITATED * np.square(blocks).sum(axis=0)
    amplitude = np.where(seen, beyond.T @ left / np.where(seen, power, 1.0), 0.0)
    k = int(np.argmax(np.abs(amplitude) * np.sqrt(power)))
    rest = left - amplitude[k] * beyond[:, k]
    chance = rms(rest) * np.sqrt(rest.size / effective_rows(rest) / max(power[k], 1e-300))
    least = LEAST_LOAD * float(np.abs(fitted.current).max())
    if abs(amplitude[k]) > max(least, BUDGET["structure"].deviations * chance):
        rows = np.flatnonzero(fitted.rows.usable)
        a, b = (evidence.time_s(int(rows[min(edge, rows.size - 1)])) for edge in edges[[starts[k], ends[k]]])
        text = f"a torque as of {amplitude[k]:+.3g} A that is no friction acts from {a:.3f} to {b:.3f} s"
        yield Reason("LoadDetected", text, "identify from moves without cutting, clamping or collision")


def torque_unexplained(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason where the model leaves more of the torque than a good one does."""
    fitted = evidence.torque
    if fitted is None or not fitted.unexplained > LARGEST_SHARE:
        return
    text = f"the model leaves {fitted.unexplained:.1%} of the torque unexplained, limit {LARGEST_SHARE:.0%}"
    yield Reason("ValidationFailed", text, "the drive does what the model does not have")
