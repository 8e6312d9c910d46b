"""Refuses a current or speed that repeats a reading, beside a slow voltage, longer than a living sensor could.

The filter that foretells the slow voltage's samples tells as well where a current or speed was whose readings are left
out: from its rows before and after, from the other sensor by [2], and from the voltage's samples by [1]. A run of equal
readings is refused where a living sensor would be there, or at either end of it, by no chance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.slow_voltage import innovations_of, spread_of
from fdhil.records import Float, Reason
from fdhil.validation.evidence import Evidence
from fdhil.validation.sensor_reconstruction import log_beyond
from fdhil.validation.stuck import TOLD_S, elsewhere, equal_runs, repeats

COLUMNS = {"current": 0, "speed": 1}  # in which column of a row's variances


def slow_stuck_values(evidence: Evidence) -> Iterator[Reason]:
    """Yield a reason for current and speed where they stick in the move."""
    for signal in evidence.signals:
        runs, limit = equal_runs(evidence, signal)
        for start, last in runs:
            if (last - start) * evidence.window.dt_s < TOLD_S:
                continue
            gap = Gap.of(evidence.judged, signal.name, signal.step, start + 1, last + 1)
            if elsewhere(gap.log_chance, (start + 1, last + 1), signal.values[start], signal.step, limit):
                yield repeats(evidence, signal, start, last, ", the other signals do not")
                break


@dataclass(frozen=True, slots=True)
class Gap:
    """A fitted window whose readings of signal ``name``, which come in a ``step``, are left out in some rows.

    ``squares`` are those of the innovations without them, ``spread`` (n, 2) the variances of all others, and ``noise``
    (3,) those of the sensors.
    """

    fit: Fit
    name: str
    step: float
    spread: Float
    noise: Float
    squares: float

    @classmethod
    def of(cls, fit: Fit, name: str, step: float, start: int, end: int) -> Gap:
        """Return the gap of rows ``start`` to ``end`` - 1; a current that was as it reads had no corner in it."""
        motion = fit.problem.motions[0]
        noise = np.maximum(fit.problem.noises[0].vector(), motion.noise.vector()) ** 2
        spread = spread_of(motion, noise)
        spread[start:end, COLUMNS[name]] = np.inf
        made = innovations_of(motion, fit.theta, noise, float(fit.theta[6]), spread=spread)
        return cls(fit, name, step, spread, noise, float(made.whitened @ made.whitened))

    def log_chance(self, first: int, end: int, level: float) -> float:
        """Return log p that a living sensor is as far from ``level`` in rows ``first`` to ``end`` - 1 of the window."""
        column, motion = COLUMNS[self.name], self.fit.problem.motions[0]
        variance = float(self.noise[1 + column]) + self.step**2 / 12.0
        spread, readings = self.spread.copy(), getattr(motion, self.name).copy()
        spread[first:end, column], readings[first:end] = variance, level
        forced = replace(motion, **{self.name: readings})
        made = innovations_of(forced, self.fit.theta, self.noise, float(self.fit.theta[6]), spread=spread)
        news = float(np.sum(1.0 - variance / made.variance[2 * first + column : 2 * end : 2]))
        return log_beyond(float(made.whitened @ made.whitened) - self.squares, max(news, 1.0))
