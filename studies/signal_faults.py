"""Faults of sensors, wiring and recorder: a valid rapid, then corrupted; each returns its severity too."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from studies import drives
from studies.drives import Rng, log_uniform
from studies.scenes import SENSORS, FaultyRecording, Rows, demand_of, draw_scene, make_recording, measure_run

LEAST_LATE_S = 1e-3
SignalFault = Callable[[Rng, Rows], tuple[Rows, float]]


def of_signals(fault: SignalFault) -> Callable[[Rng], FaultyRecording]:
    """Return the maker of valid rapids whose recording is then corrupted."""

    def make(rng: Rng) -> FaultyRecording:
        scene = draw_scene(rng)
        rows = measure_run(rng, scene, drives.simulate_loop(scene.drive, demand_of(scene), scene.dt_s))
        corrupted, severity = fault(rng, rows)
        return FaultyRecording(make_recording(scene, corrupted), severity)

    return make


def _sensor(rng: Rng) -> str:
    return str(rng.choice(SENSORS))


def sign(rng: Rng) -> float:
    """Draw a sign."""
    return float(rng.choice([-1.0, 1.0]))


def clipped(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share of a sensor's peak that is cut off."""
    name, cut = _sensor(rng), rng.uniform(0.05, 0.5)
    rail = (1 - cut) * rows.find_peak(name)
    return rows.replace_signals(**{name: np.clip(rows.signals[name], -rail, rail)}), cut


def gain_step(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share by which a sensor's gain steps within the move."""
    name, amount = _sensor(rng), log_uniform(rng, 0.03, 0.2)
    values = rows.signals[name].copy()
    begin, end = rows.moving
    values[int(begin + rng.uniform(0.2, 0.8) * (end - begin)) :] *= 1 + sign(rng) * amount
    return rows.replace_signals(**{name: values}), amount


def gain_drift(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share by which a sensor's gain drifts steadily from the move's begin to its end."""
    name, amount = _sensor(rng), log_uniform(rng, 0.04, 0.2)
    begin, end = rows.moving
    course = np.clip((np.arange(rows.signals[name].size) - begin) / (end - begin), 0, 1)
    return rows.replace_signals(**{name: rows.signals[name] * (1 + sign(rng) * amount * course)}), amount


def offset(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share of a sensor's peak by which its zero is off.

    The noisiest windows at 2 ms know a zero to 0.4 % of the peak: 5.5 deviations are the least that is told.
    """
    name, amount = _sensor(rng), log_uniform(rng, 0.022, 0.08)
    return rows.replace_signals(**{name: rows.signals[name] + sign(rng) * amount * rows.find_peak(name)}), amount


def offset_drift(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share of a sensor's peak by which its zero drifts from the recording's begin to its end."""
    name, amount = _sensor(rng), log_uniform(rng, 0.03, 0.10)
    course = np.linspace(0, 1, rows.signals[name].size)
    return rows.replace_signals(
        **{name: rows.signals[name] + sign(rng) * amount * rows.find_peak(name) * course}
    ), amount


def stuck(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Seconds for which a sensor repeats one value while what it measures moves.

    A steady signal whose steps are coarse is repeated by a working sensor too: there, no reading tells the fault.
    """
    while True:
        name, seconds = _sensor(rng), rng.uniform(0.02, 0.1)
        length = round(seconds / rows.dt_s)
        start = int(rng.uniform(rows.moving[0], rows.moving[1] - length))
        if rows.sensors[name].is_moving_beyond(start, start + length):
            break
    values = rows.signals[name].copy()
    values[start : start + length] = values[start]
    return rows.replace_signals(**{name: values}), seconds


def voltage_late(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Samples by which the voltage is late: 1 ms at least.

    The noisiest windows with rows of 0.25 ms know a delay to 0.13 ms, while L and R are fitted with it.
    """
    shift = max(int(rng.integers(2, 13)), math.ceil(LEAST_LATE_S / rows.dt_s))
    v = rows.signals["voltage"]
    return rows.replace_signals(voltage=np.concatenate([np.full(shift, v[0]), v[:-shift]])), float(shift)


def current_late(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Samples by which the current is late against voltage and speed."""
    shift = int(rng.integers(2, 9))
    i = rows.signals["current"]
    return rows.replace_signals(current=np.concatenate([np.full(shift, i[0]), i[:-shift]])), float(shift)


def lagging_sensor(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Samples of a sensor's own low-pass time constant."""
    name, samples = _sensor(rng), rng.uniform(2.5, 10)
    pole = float(np.exp(-1 / samples))
    values = rows.signals[name].copy()
    for k in range(1, values.size):
        values[k] = pole * values[k - 1] + (1 - pole) * values[k]
    return rows.replace_signals(**{name: values}), samples


def frames_lost(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Seconds of samples that are lost while the time column is renumbered."""
    seconds = rng.uniform(0.015, 0.1)
    length = round(seconds / rows.dt_s)
    start = int(rng.uniform(rows.moving[0] + 0.3 * (rows.cruise[0] - rows.moving[0]), rows.cruise[1] - length))
    keep = np.r_[0:start, start + length : rows.signals["speed"].size]
    return rows.replace_signals(**{name: values[keep] for name, values in rows.signals.items()}), seconds


def counted_gap(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Samples that are lost, and reported as lost, in one stretch within the move."""
    length = int(rng.integers(4, 60))
    start = int(rng.uniform(rows.moving[0], rows.moving[1] - length))
    signals = {name: values.copy() for name, values in rows.signals.items()}
    for values in signals.values():
        values[start : start + length] = np.nan
    return rows.replace_signals(**signals), float(length)


def not_finite(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Samples of one sensor that are NaN or infinite."""
    name, count = _sensor(rng), int(rng.integers(1, 20))
    values = rows.signals[name].copy()
    values[rng.integers(rows.moving[0], rows.moving[1], count)] = rng.choice([np.nan, np.inf, -np.inf])
    return rows.replace_signals(**{name: values}), float(count)


def speed_scale(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share by which the speed's scale, or the pitch, is off."""
    amount = log_uniform(rng, 0.02, 0.15)
    return rows.replace_signals(speed=rows.signals["speed"] * (1 + sign(rng) * amount)), amount


def wrong_sign(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """One signal has the wrong sign."""
    name = _sensor(rng)
    return rows.replace_signals(**{name: -rows.signals[name]}), 1.0


def swapped_columns(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Two columns are swapped."""
    one, other = rng.choice(SENSORS, 2, replace=False)
    return rows.replace_signals(**{str(one): rows.signals[str(other)], str(other): rows.signals[str(one)]}), 1.0


def late_trigger(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share of the acceleration that is not recorded."""
    missed = rng.uniform(0.3, 1.2)
    start = int(rows.moving[0] + missed * (rows.cruise[0] - rows.moving[0]))
    return rows.replace_signals(**{name: values[start:] for name, values in rows.signals.items()}), missed


def ends_early(rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Share of the cruise that is recorded, the braking not."""
    share = rng.uniform(0.3, 1.0)
    end = int(rows.cruise[0] + share * (rows.cruise[1] - rows.cruise[0]))
    return rows.replace_signals(**{name: values[:end] for name, values in rows.signals.items()}), share


def constant_speed(_rng: Rng, rows: Rows) -> tuple[Rows, float]:
    """Nothing but full speed is recorded."""
    a, b = rows.cruise
    a += round(0.3 * (b - a))
    return rows.replace_signals(**{name: values[a:b] for name, values in rows.signals.items()}), 1.0
