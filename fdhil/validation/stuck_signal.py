"""Refuses a sensor that repeats a reading longer than a working one could: by its noise, neighbours, other sensors.

A steady signal that is read coarsely repeats itself for long, and that is no fault. So the probability of a run of
equal readings is computed: noise would have changed a reading even in the middle of a step; or the neighbouring rows
change more often; or, in motion, the fitted model and the other two sensors place the signal elsewhere. A run is
refused if one of these leaves a probability below the budget's, shared by all readings at which one might begin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fdhil.identification import sort_runs_by_length
from fdhil.records import Bool, Float, Reason
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.repeated_readings import (
    LEAST_NOISE_ROWS,
    SIDE,
    compute_repeat_probability,
    has_jump_after,
    is_beyond_chance,
)
from fdhil.validation.sensor_reconstruction import SensorReconstruction
from fdhil.validation.signal_consistency import is_confirmed_by_position
from fdhil.validation.signal_plausibility import RAIL_SAMPLES
from fdhil.validation.window_fit import WindowFit
from fdhil.validation.window_signals import SensorSignal

NOISES = {"voltage": "voltage_v", "current": "current_a", "speed": "speed_rad_s"}
SHORTEST_S = 0.003
COMPARED_S = 0.010  # the shortest run that is compared with its neighbours or the other signals
COMPUTED = 2.0  # times that, for a speed computed from positions: its neighbours scatter without noise
LONGEST_RUNS = 2  # of a signal that are checked: a sensor sticks longer than chance repeats
LEAST_NOISE = 0.2  # steps: noise hidden by the resolution
INFORMATIVE_NOISE = 0.6  # steps: below it, the scatter of readings depends on the signal's position within its step
MOST_NOISE = 3.0  # steps: with more, a working sensor repeats no reading, whatever the position
LEAST_CHANGES = 6  # of a held reading, at equal numbers of rows
PARTS = 4  # of a run: its first and its last one are checked alone too
WITHIN_STEP = 0.3  # of a step: distance from its middle of a constant that is read there for long


@dataclass(frozen=True)
class SensorReadings:
    """One sensor over the window: ``steps`` (n,) in units of its resolution, and the half-open rows of the move."""

    signal: SensorSignal
    begin: int
    end: int
    dt_s: float

    @cached_property
    def steps(self) -> Float:
        """The readings (n,) in steps."""
        return np.rint(self.signal.values / self.signal.step)

    @cached_property
    def noise(self) -> float:
        """The noise in the move, in steps."""
        return estimate_noise_steps(self.steps[self.begin : self.end])

    @cached_property
    def rails(self) -> tuple[float, float]:
        """The least and the largest reading."""
        return float(np.nanmin(self.steps)), float(np.nanmax(self.steps))

    def is_beyond_neighbour_chance(self, start: int, last: int) -> bool:
        """Return whether the run is longer than the changes of its neighbouring rows explain."""
        return is_beyond_chance(self.steps[self.begin : self.end], start - self.begin, last - self.begin)


def find_stuck_sensors(fitted: WindowFit) -> Iterator[Reason]:
    """Yield a reason for each sensor that stuck during the move; without a fit, by its own rows alone."""
    signals = fitted.signals
    begin, end = signals.motion_range
    for signal in signals.varying_sensors:
        if signal.step == 0.0:
            continue
        readings = SensorReadings(signal, begin, end, signals.window.dt_s)
        same = np.diff(signal.values[begin:end]) == 0.0
        held = _determine_update_interval(same)
        if held > 1 and held * readings.dt_s >= COMPARED_S:
            text = f"{signal.name} changes only every {1e3 * held * readings.dt_s:.3g} ms: samples in between repeat it"
            yield Reason("StuckValue", text, "record it at the drive's own rate, or at the rate at which it changes")
            continue
        limit = BUDGET["stuck"].log_chance - math.log(np.count_nonzero(~same) + 2)
        runs = ((begin + start, begin + last) for start, last in sort_runs_by_length(same)[:LONGEST_RUNS])
        stuck = next((run for run in runs if _is_stuck_run(fitted, readings, *run, limit)), None)
        if stuck is not None:
            lasts_ms = 1e3 * (stuck[1] - stuck[0] + 1) * signals.window.dt_s
            text = (
                f"{signal.name} repeats {signal.values[stuck[0]]:.6g} {signal.unit} for {lasts_ms:.0f} ms "
                f"from {signals.get_time_s(stuck[0]):.3f} s while the axis moves"
            )
            yield Reason("StuckValue", text, "check the sensor or the object's mapping")


def _determine_update_interval(same: Bool) -> int:
    """Return the number of rows between changes of the readings, if it is regular beyond chance; else 1."""
    changes = np.flatnonzero(~same)
    rows = int(np.gcd.reduce(np.diff(changes))) if changes.size >= LEAST_CHANGES else 1
    surely = rows > 1 and -(changes.size - 1) * math.log(rows) < BUDGET["stuck"].log_chance
    return rows if surely else 1


def find_clipped_peaks(fitted: WindowFit) -> Iterator[Reason]:
    """Yield a reason for each sensor whose extreme was clipped although its own rows do not show it.

    Model and the other sensors show where it should have been.
    """
    signals, fit, bridge = fitted.signals, fitted.required_fit, fitted.reconstruction
    if bridge is None:
        return
    for signal in signals.varying_sensors:
        noise, values = getattr(fit.problem.noises[0], NOISES[signal.name]), signal.values
        for rail in (np.nanmax(values), np.nanmin(values)):
            runs = sort_runs_by_length(values == rail, RAIL_SAMPLES) if rail != 0.0 else []
            if runs and is_beyond_chance(values, runs[0][0], runs[0][1] - 1):
                continue  # found without a model already
            for start, end in runs:
                crossing = bridge.omit_readings(signal.name, start, end)
                if crossing is None:
                    continue
                if is_confirmed_by_position(signals.window, signal, start, end):
                    continue
                if (
                    crossing.compute_log_probability(start, end, float(rail), float(noise))
                    >= BUDGET["cut off"].log_chance
                ):
                    continue
                text = (
                    f"{signal.name} stays at its extreme {rail:.6g} {signal.unit} for {end - start} samples from "
                    f"{signals.get_time_s(start):.3f} s, where the other signals show more"
                )
                yield Reason("Saturated", text, "use a larger measuring range")
                break


def _is_stuck_run(fitted: WindowFit, readings: SensorReadings, start: int, last: int, limit: float) -> bool:
    if (last - start) < max(2, round(SHORTEST_S / readings.dt_s)):
        return False
    if readings.steps[start] in readings.rails:
        return False  # reported as saturation
    if readings.noise < MOST_NOISE and is_confirmed_by_position(fitted.window, readings.signal, start, last + 1):
        return False
    computed = readings.signal.name == "speed" and fitted.window.speed_late_s is not None
    if not computed and _is_quieter_than_noise(readings, start, last, limit):
        return True
    if (last - start) * readings.dt_s < (COMPUTED * COMPARED_S if computed else COMPARED_S):
        return False
    if readings.is_beyond_neighbour_chance(start, last):
        return True
    bridge = fitted.reconstruction
    if bridge is None:
        part = readings.steps[readings.begin : readings.end]
        return has_jump_after(part, start - readings.begin, last - readings.begin)
    return _is_contradicted_by_model(bridge, readings, start, last, limit)


def _is_contradicted_by_model(
    bridge: SensorReconstruction, readings: SensorReadings, start: int, last: int, limit: float
) -> bool:
    """Return whether the model and the other sensors place the signal elsewhere over the run, or at either end.

    The error of a stuck sensor is largest just before it resumes.
    """
    crossing = bridge.omit_readings(readings.signal.name, start + 1, last + 1)
    if crossing is None:
        return False
    step = readings.signal.step
    deviation = step * math.sqrt(readings.noise**2 + 1.0 / 12.0)
    levels = [step * (readings.steps[start] + share) for share in (0.0, -WITHIN_STEP, WITHIN_STEP)]
    part = (last - start) // PARTS
    spans = ((start + 1, last + 1), (last + 1 - part, last + 1), (start + 1, start + 1 + part))
    limit -= math.log(len(spans))
    return any(
        all(crossing.compute_log_probability(*span, level, deviation) < limit for level in levels) for span in spans
    )


def _is_quieter_than_noise(readings: SensorReadings, start: int, last: int, limit: float) -> bool:
    """Return whether noise would have changed a reading even of a constant in the middle of its step."""
    steps, rows = readings.steps, SIDE * (last - start + 1)
    if (
        readings.noise < INFORMATIVE_NOISE
        or (last - start) * math.log(compute_repeat_probability(readings.noise)) > limit
    ):
        return False
    sides = (steps[max(0, start - rows) : start], steps[last + 1 : last + 1 + rows])
    least = min([estimate_noise_steps(side) for side in sides if side.size >= LEAST_NOISE_ROWS], default=readings.noise)
    return least >= INFORMATIVE_NOISE and (last - start) * math.log(compute_repeat_probability(least)) < limit


def estimate_noise_steps(readings: Float) -> float:
    """Return the noise of a quantised signal in steps, from its third differences without those at corners."""
    third = np.diff(readings, 3)
    square = third[np.isfinite(third)] ** 2
    if square.size == 0:
        return LEAST_NOISE
    power, before = float(square.mean()), math.inf
    while power < before:
        before, kept = power, square[square <= max(9.0 * power, 1.0)]
        power = float(kept.mean())
    return math.sqrt(max(power / 20.0 - 1.0 / 12.0, LEAST_NOISE**2))
