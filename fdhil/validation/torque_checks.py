"""Checks that need current and position alone: a late current, an intermittent load, unexplained torque."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fdhil.identification import (
    TorqueFit,
    count_effective_samples,
    estimate_current_lag_s,
    invert_gram,
    list_candidate_terms,
)
from fdhil.records import Reason, compute_rms
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.signal_delays import build_delay_reason
from fdhil.validation.window_signals import WindowSignals

EDGES = 20  # instants at which a load may begin or end
LEAST_LOAD = 0.05  # of the peak current: a screw's friction varies along its length by less
LARGEST_SHARE = 0.10  # of the torque's RMS that a valid model of the drive may leave unexplained
LATE_ROWS = 1.0
IMITATED = 1e-6  # of a course's power, below which only rounding remains


def check_torque_delay(fitted: TorqueFit, dt: float) -> Iterator[Reason]:
    """Yield a reason if the current is late or early against the motion by significantly more than a row."""
    late, std = estimate_current_lag_s(fitted)
    if abs(late) > LATE_ROWS * dt + BUDGET["timing"].deviations * std:
        yield build_delay_reason("current", "the motion", late, dt)


@dataclass(frozen=True, slots=True)
class LoadTorque:
    """A torque of ``amplitude`` A, with its standard deviation, over the half-open rows to fit ``begin`` to ``end``."""

    amplitude: float
    std: float
    begin: int
    end: int


def detect_intermittent_load(fitted: TorqueFit, signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason if a torque acts during part of the move that neither the model nor friction explains."""
    load = find_most_significant_load(fitted)
    least = LEAST_LOAD * float(np.abs(fitted.current).max())
    if abs(load.amplitude) > max(least, BUDGET["structure"].deviations * load.std):
        rows = np.flatnonzero(fitted.rows.usable)
        a, b = (signals.get_time_s(int(row)) for row in rows[[load.begin, load.end - 1]])
        text = f"a torque equivalent to {load.amplitude:+.3g} A, other than friction, acts from {a:.3f} to {b:.3f} s"
        yield Reason(
            "LoadDetected",
            text,
            "identify from moves without cutting, clamping or collision, or check current and position",
        )


def find_most_significant_load(fitted: TorqueFit) -> LoadTorque:
    """Return the most significant load between two edges, in addition to all possible friction.

    Friction at low speed and ripples are no load, whether they were added to the model or not.
    """
    design = np.column_stack([fitted.design, *(term.columns for term in list_candidate_terms(fitted))])
    inverse, _ = invert_gram(design)
    left = fitted.current - design @ (inverse @ (design.T @ fitted.current))
    edges = np.linspace(0, left.size, EDGES + 1).astype(int)
    # products of a step up to an edge with design and residual are sums up to that edge; a load is two steps
    shared = np.vstack([np.zeros(len(inverse)), np.cumsum(design, axis=0)])[edges]
    score = np.append(0.0, np.cumsum(left))[edges]
    gram = np.minimum.outer(edges, edges) - shared @ inverse @ shared.T
    a, b = np.triu_indices(EDGES + 1, 1)
    power = gram[b, b] + gram[a, a] - 2.0 * gram[b, a]
    seen = power > IMITATED * (edges[b] - edges[a])
    amplitudes = np.where(seen, (score[b] - score[a]) / np.where(seen, power, 1.0), 0.0)
    k = int(np.argmax(np.abs(amplitudes) * np.sqrt(np.maximum(power, 0.0))))
    amplitude, begin, end = float(amplitudes[k]), int(edges[a[k]]), int(edges[b[k]])
    rest = left + amplitude * (design @ (inverse @ (shared[b[k]] - shared[a[k]])))
    rest[begin:end] -= amplitude
    std = compute_rms(rest) * float(np.sqrt(rest.size / count_effective_samples(rest) / max(power[k], 1e-300)))
    return LoadTorque(amplitude, std, begin, end)


def check_unexplained_torque(fitted: TorqueFit) -> Iterator[Reason]:
    """Yield a reason if the model leaves more of the torque than a good one does."""
    if not fitted.unexplained > LARGEST_SHARE:
        return
    text = f"the model leaves {fitted.unexplained:.1%} of the torque unexplained, limit {LARGEST_SHARE:.0%}"
    advice = "the drive has an effect that the model lacks, or current and speed are not sampled at one instant"
    yield Reason("ValidationFailed", text, advice)
