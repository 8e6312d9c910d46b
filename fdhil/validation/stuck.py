"""Does a sensor repeat a reading longer than a living one could? Judged by its own noise, its neighbours, the others.

A steady signal that is read coarsely repeats itself for long, and that is no fault. So a run of equal readings is
judged by how likely it was: noise would have changed a reading even in the middle of a step; or it is no part of the
steady signal beside it; or, where it moves, the fitted model and the other two sensors say that it was elsewhere. A run
is refused where one of these leaves a chance below ``CHANCE``, shared by all readings at which one might begin.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial

import numpy as np

from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.motion import resolution
from fdhil.identification.windows import moving_range, runs_of
from fdhil.records import Float, Reason, Window
from fdhil.validation.plausibility import RAIL_SAMPLES, beyond_chance, signals_of, wakes_with_a_jump
from fdhil.validation.repeated_readings import alike, log_chance
from fdhil.validation.sensor_reconstruction import Bridge

CHANCE = 2e-3  # of a false alarm of one signal in one good window, were its runs explained by what is drawn at random
NOISES = {"voltage": "voltage_v", "current": "current_a", "speed": "speed_rad_s"}
LOG_CLIPPED = math.log(1e-6)  # at an extreme the voltage's course within a row is known least
SHORTEST_S = 0.003
TOLD_S = 0.010  # the shortest run that its neighbours or the other signals are asked about
LONGEST_RUNS = 2  # of a signal that are judged: a sensor sticks longer than chance repeats
LEAST_NOISE = 0.2  # steps: what hides in the resolution
TOLD_NOISE = 0.6  # steps: below it, how readings scatter depends on where in its step the signal lies
LEAST_NOISE_ROWS = 20
SIDE, MOST_ROWS = 3, 250  # rows to either side that tell of a run: in its own lengths, and at most
LEAST_ROWS = 6
PARTS = 4  # of a run: its first and its last one are judged alone too
WITHIN_STEP = 0.3  # of a step: how far from its middle a constant may lie that is read there for long
STEADY_STEPS, STEADY_DEVIATIONS = 2.0, 3.0  # of the run's reading: what lies nearer is steady


@dataclass(frozen=True)
class Signal:
    """One sensor over the window: ``readings`` (n,) in units of its ``step``, and the half-open rows of the move."""

    name: str
    readings: Float
    step: float
    begin: int
    end: int
    dt_s: float

    @cached_property
    def noise(self) -> float:
        """Return the noise in the move, in steps."""
        return noise_steps(self.readings[self.begin : self.end])

    @cached_property
    def rails(self) -> tuple[float, float]:
        """Return the least and the largest reading."""
        return float(np.nanmin(self.readings)), float(np.nanmax(self.readings))


def stuck_values(window: Window, fit: Fit | None) -> Iterator[Reason]:
    """Yield a reason for each sensor that surely stuck during the move; ``fit`` is the window's, where there is one."""
    bridge = cache(partial(Bridge.over, fit)) if fit is not None and _bears(fit) else None
    begin, end = moving_range(window)
    for name, unit, values in signals_of(window):
        same = np.concatenate([[False], np.diff(values[begin:end]) == 0.0, [False]])
        starts, after = np.flatnonzero(np.diff(same.astype(np.int8))).reshape(-1, 2).T
        lengths = after - starts
        if lengths.max(initial=0) < max(2, round(SHORTEST_S / window.dt_s)):
            continue
        step = resolution(values[np.isfinite(values)])
        if step == 0.0:
            continue
        signal = Signal(name, np.rint(values / step), step, begin, end, window.dt_s)
        limit = math.log(CHANCE / np.count_nonzero(~same))
        for k in np.argsort(-lengths, kind="stable")[:LONGEST_RUNS]:
            start, last = begin + int(starts[k]), begin + int(after[k])
            if _is_stuck(signal, start, last, limit, bridge):
                text = (
                    f"{name} repeats {values[start]:.6g} {unit} for {(last - start + 1) * window.dt_s * 1e3:.0f} ms "
                    f"from {window.start_s + start * window.dt_s:.3f} s while the axis moves"
                )
                yield Reason("StuckValue", text, "check the sensor or the object's mapping")
                break
    if bridge is not None and fit is not None:
        yield from _clipped_peaks(window, fit, bridge)


def _clipped_peaks(window: Window, fit: Fit, bridge: Callable[[], Bridge]) -> Iterator[Reason]:
    """Yield a reason for each sensor whose extreme was cut off where its rows do not show it by themselves.

    Model and the other sensors tell where it should have been.
    """
    for name, unit, values in signals_of(window):
        noise = getattr(fit.problem.noises[0], NOISES[name])
        for rail in (np.nanmax(values), np.nanmin(values)):
            runs = runs_of(values == rail, RAIL_SAMPLES) if rail != 0.0 else []
            if runs and beyond_chance(values, runs[0][0], runs[0][1] - 1):
                continue  # this is told without a model
            for start, end in runs:
                crossing = bridge().crossing(name, start, end)
                if crossing is None or crossing.log_chance(start, end, float(rail), float(noise)) >= LOG_CLIPPED:
                    continue
                text = (
                    f"{name} stays at its extreme {rail:.6g} {unit} for {end - start} samples from "
                    f"{window.start_s + start * window.dt_s:.3f} s, where the other signals tell more"
                )
                yield Reason("Saturated", text, "use a larger measuring range")
                break


def _bears(fit: Fit) -> bool:
    """Return whether the fit can tell what a sensor should have read."""
    motion, theta = fit.problem.motions[0], fit.theta
    finite = bool(np.isfinite(theta).all() and np.isfinite(fit.problem.noises[0].vector()).all())
    return motion.slow is None and finite and bool((theta[:4] > 0).all()) and abs(theta[6]) <= motion.dt_s


def _is_stuck(signal: Signal, start: int, last: int, limit: float, bridge: Callable[[], Bridge] | None) -> bool:
    """Return whether rows ``start`` to ``last``, all alike, are less likely than ``limit`` by every explanation."""
    if (last - start) < max(2, round(SHORTEST_S / signal.dt_s)):
        return False
    at_rail = signal.readings[start] in signal.rails  # that is for saturation to explain
    if not at_rail and _quieter_than_noise(signal, start, last, limit):
        return True
    if (last - start) * signal.dt_s < TOLD_S:
        return False
    left, right = _steady_rows(signal, start, last)
    length = last - start + 1
    whole = min(length, MOST_ROWS)
    steady = max(left, right) >= whole
    if steady and _departs_from_neighbours(signal, start, last, (left, right), limit):
        return True
    if at_rail or (steady and (bridge is None or min(left, right) >= whole)):
        return False
    if bridge is not None:
        return _departs_from_others(signal, start, last, limit, bridge())
    part = signal.readings[signal.begin : signal.end]
    first, end = start - signal.begin, last - signal.begin
    return beyond_chance(part, first, end) or wakes_with_a_jump(part, first, end)


def _quieter_than_noise(signal: Signal, start: int, last: int, limit: float) -> bool:
    """Return whether noise would have changed a reading even of a constant in the middle of its step."""
    readings, rows = signal.readings, SIDE * (last - start + 1)
    if signal.noise < TOLD_NOISE:
        return False
    if (last - start) * math.log(alike(signal.noise)) > limit:
        return False
    sides = (readings[max(0, start - rows) : start], readings[last + 1 : last + 1 + rows])
    least = min([noise_steps(side) for side in sides if side.size >= LEAST_NOISE_ROWS], default=signal.noise)
    return least >= TOLD_NOISE and (last - start) * math.log(alike(least)) < limit


def noise_steps(readings: Float) -> float:
    """Return the noise of a signal read in steps, from its third differences without those that a corner makes."""
    third = np.diff(readings, 3)
    square = third[np.isfinite(third)] ** 2
    if square.size == 0:
        return LEAST_NOISE
    power, before = float(square.mean()), math.inf
    while power < before:
        before, kept = power, square[square <= max(9.0 * power, 1.0)]
        power = float(kept.mean())
    return math.sqrt(max(power / 20.0 - 1.0 / 12.0, LEAST_NOISE**2))


def _steady_rows(signal: Signal, start: int, last: int) -> tuple[int, int]:
    """Return how many rows before and after the run stay near its reading."""
    most = min(SIDE * (last - start + 1), MOST_ROWS)
    band = STEADY_STEPS + STEADY_DEVIATIONS * signal.noise
    near = np.abs(signal.readings[max(0, start - most) : last + 1 + most] - signal.readings[start]) <= band
    first, end = start - max(0, start - most), last + 1 - max(0, start - most)
    before, after = ~near[:first][::-1], ~near[end:]
    left = int(np.argmax(before)) if before.any() else before.size
    right = int(np.argmax(after)) if after.any() else after.size
    return left, right


def _departs_from_neighbours(signal: Signal, start: int, last: int, steady: tuple[int, int], limit: float) -> bool:
    """Return whether no smooth course through the steady rows beside the run explains it, be it short or long."""
    readings, length = signal.readings, last - start + 1
    beside = readings[start - min(steady[0], length) : last + 1 + min(steady[1], length)]
    equal = int(np.count_nonzero(beside == readings[start])) - length
    # a first look: as often as its neighbours have the reading
    if (length - 1) * math.log((equal + 1) / (beside.size - length + 2)) > limit / 2:
        return False
    noise = 1.25 * signal.noise
    sides = [(min(steady[0], most), min(steady[1], most)) for most in (length, MOST_ROWS)]
    tried = [(*rows, degree) for rows in sides for degree in (2, 3) if min(rows) >= LEAST_ROWS]
    # where the signal was steady for less than the run's own length, it may have come to rest only as the run began
    tried += [(0, steady[1], degree) for degree in (1, 2) if steady[0] < min(length, MOST_ROWS)]
    tried += [(steady[0], 0, degree) for degree in (1, 2) if steady[1] < min(length, MOST_ROWS)]
    return all(
        log_chance(readings, start, last, before, after, degree, noise) < limit for before, after, degree in tried
    )


def _departs_from_others(signal: Signal, start: int, last: int, limit: float, bridge: Bridge) -> bool:
    """Return whether the signal was elsewhere by what the model and the other sensors tell: over the run, or at an end.

    A sensor that sticks is furthest from the truth where it wakes.
    """
    crossing = bridge.crossing(signal.name, start + 1, last + 1)
    if crossing is None:
        return False
    deviation = signal.step * math.sqrt(signal.noise**2 + 1.0 / 12.0)
    levels = [signal.step * (signal.readings[start] + share) for share in (0.0, -WITHIN_STEP, WITHIN_STEP)]
    part = (last - start) // PARTS
    limit -= math.log(3.0)
    for first, end in ((start + 1, last + 1), (last + 1 - part, last + 1), (start + 1, start + 1 + part)):
        if all(crossing.log_chance(first, end, level, deviation) < limit for level in levels):
            return True
    return False
