"""Does current or speed repeat a reading longer than a living sensor could, beside a slow voltage?

The filter that foretells the slow voltage's samples tells as well where a current or speed was whose readings are left
out: from its rows before and after, from the other sensor by [2], and from the voltage's samples by [1]. A run of equal
readings is refused where a living sensor would be there, or at either end of it, by no chance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.motion import Motion, resolution
from fdhil.identification.slow_voltage import innovations_of, spread_of
from fdhil.identification.windows import moving_range
from fdhil.records import Float, Reason, Window
from fdhil.validation.plausibility import signals_of
from fdhil.validation.sensor_reconstruction import log_beyond
from fdhil.validation.stuck import CHANCE, LONGEST_RUNS, PARTS, TOLD_S, WITHIN_STEP

ROWS = {"current": 0, "speed": 1}  # in which column of a row's variances


def slow_stuck_values(window: Window, fit: Fit) -> Iterator[Reason]:
    """Yield a reason for current and speed where they stick in the move; the ``fit`` is that of the ``window``."""
    begin, end = moving_range(window)
    for name, unit, values in signals_of(window):
        same = np.concatenate([[False], np.diff(values[begin:end]) == 0.0, [False]])
        edges = np.flatnonzero(np.diff(same.astype(np.int8))).reshape(-1, 2) + begin
        runs = sorted(((int(a), int(b)) for a, b in edges), key=lambda run: run[0] - run[1])[:LONGEST_RUNS]
        limit = math.log(CHANCE / max(1, int(np.count_nonzero(~same))))
        step = resolution(values[np.isfinite(values)])
        for start, last in runs:
            if (last - start) * window.dt_s >= TOLD_S and Gap.of(fit, name, start + 1, last + 1).unlike(
                values[start], step, limit
            ):
                text = (
                    f"{name} repeats {values[start]:.6g} {unit} for {(last - start + 1) * window.dt_s * 1e3:.0f} ms "
                    f"from {window.start_s + start * window.dt_s:.3f} s, the other signals do not"
                )
                yield Reason("StuckValue", text, "check the sensor or the object's mapping")
                break


@dataclass(frozen=True, slots=True)
class Gap:
    """A fitted window whose readings of one signal are left out in rows ``start`` to ``end`` - 1.

    ``squares`` are those of the innovations without them, ``spread`` (n, 2) the variances of all others.
    """

    fit: Fit
    motion: Motion
    name: str
    start: int
    end: int
    spread: Float
    noise: Float
    squares: float

    @classmethod
    def of(cls, fit: Fit, name: str, start: int, end: int) -> Gap:
        """Return the gap; a current that was as it reads had no corner in it."""
        motion = fit.problem.motions[0]
        noise = np.maximum(fit.problem.noises[0].vector(), motion.noise.vector()) ** 2
        spread = spread_of(motion, noise)
        spread[start:end, ROWS[name]] = np.inf
        made = innovations_of(motion, fit.theta, noise, float(fit.theta[6]), spread=spread)
        return cls(fit, motion, name, start, end, spread, noise, float(made.whitened @ made.whitened))

    def unlike(self, level: float, step: float, limit: float) -> bool:
        """Return whether the signal was elsewhere than ``level`` over the gap or at an end, each by log p < ``limit``.

        A sensor that sticks is furthest from the truth where it wakes.
        """
        part = max(1, (self.end - self.start) // PARTS)
        levels = [level + share * step for share in (0.0, -WITHIN_STEP, WITHIN_STEP)]
        spans = ((self.start, self.end), (self.end - part, self.end), (self.start, self.start + part))
        return any(
            all(self.log_chance(first, end, at, step) < limit - math.log(len(spans)) for at in levels)
            for first, end in spans
        )

    def log_chance(self, first: int, end: int, level: float, step: float) -> float:
        """Return log p that a living sensor is as far from ``level`` in rows ``first`` to ``end`` - 1 of the window."""
        column = ROWS[self.name]
        variance = float(self.noise[1 + column]) + step**2 / 12.0
        spread, readings = self.spread.copy(), getattr(self.motion, self.name).copy()
        spread[first:end, column], readings[first:end] = variance, level
        forced = replace(self.motion, **{self.name: readings})
        made = innovations_of(forced, self.fit.theta, self.noise, float(self.fit.theta[6]), spread=spread)
        news = float(np.sum(1.0 - variance / made.variance[2 * first + column : 2 * end : 2]))
        return log_beyond(float(made.whitened @ made.whitened) - self.squares, max(news, 1.0))
