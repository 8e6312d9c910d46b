"""Checks that the signals of a rapid are consistent, whatever the drive's parameters are.

Every rapid accelerates, cruises and brakes. So each signal changes; position and demand travel as far as the integral
of speed; the current produces acceleration and friction, and the voltage overcomes the back-EMF and drives that
current: both follow the speed and its rate. No two signals are the same column.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from fdhil.identification import fill_forward, find_resolution, interpolate_gaps, smooth_samples, solve_least_squares
from fdhil.records import Float, Reason, Recording, Window
from fdhil.validation.window_signals import SensorSignal, WindowSignals

UNITS: Mapping[str, str] = {"voltage": "V", "current": "A", "speed": "rad/s", "position": "mm", "demand": "mm"}
LEAST_FOLLOWED: Mapping[str, float] = {"voltage": 0.5, "current": 0.3}  # of their variance, by a rapid of any drive
LEAST_SAMPLES = 12  # of a signal, by which it may be compared with the motion
TABLE_MM, TABLE_SHARE = 1.0, 0.05  # by which a table may differ from the motor: backlash, a soft screw, a late sensor
TABLE_GAIN, TABLE_FOLLOWS = 1.5, 0.3  # scale error of an accelerometer, and its share explained by the motor
QUANTISATION_STEPS = 1.5  # of a position: joint quantisation error of two readings
SAME = 1e-9  # of the peak, to which one column is a multiple of another
LONGEST_CYCLE_S = 0.012  # longest cycle of an NC, in which its demand changes once
STILL_MM = 1.0  # travel from which a recording contains a move


def collect_recorded_signals(window: Window) -> dict[str, Float]:
    """Return the recorded signals (n,), by name; one that is missing throughout is left out."""
    signals = {
        "voltage": window.voltage_v,
        "current": window.current_a,
        "speed": window.speed_rad_s,
        "position": window.position_mm,
        "demand": window.demand_mm,
    }
    return {name: values for name, values in signals.items() if values is not None and np.isfinite(values).any()}


def integrate_travel_mm(speed_rad_s: Float, dt_s: float, pitch_mm: float) -> Float:
    """Return the integral (n,) of the speed in mm of the table; lost samples are interpolated."""
    speed = interpolate_gaps(speed_rad_s)
    steps = (speed[1:] + speed[:-1]) * (dt_s * pitch_mm / (4 * math.pi))
    return np.concatenate([[0.0], np.cumsum(steps)])


def find_constant_signals(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason for each signal that does not change while the axis moves, and for a demand that jumps."""
    window, (begin, end) = signals.recorded or signals.window, signals.motion_range
    if not np.isfinite(window.speed_rad_s).any():
        return
    travel = integrate_travel_mm(window.speed_rad_s, window.dt_s, window.pitch_mm)
    part = travel[begin:end]
    moved_mm = float(part[-1] - part[0]) if part.size else 0.0
    if window.slow_voltage is not None:
        readings = window.slow_voltage.voltage_v[np.isfinite(window.slow_voltage.voltage_v)]
        if readings.size >= LEAST_SAMPLES and np.ptp(readings) == 0.0:
            yield _build_constant_reason("voltage", float(readings[0]), moved_mm)
    for name, values in collect_recorded_signals(window).items():
        moving = values[begin:end][np.isfinite(values[begin:end])]
        if moving.size >= LEAST_SAMPLES and np.ptp(moving) == 0.0:
            yield _build_constant_reason(name, float(moving[0]), moved_mm)
        elif name == "demand":
            yield from _find_demand_jump(signals, values)


def _build_constant_reason(name: str, value: float, moved_mm: float) -> Reason:
    text = f"{name} stays at {value:.6g} {UNITS[name]} while the integral of speed travels {moved_mm:.4g} mm"
    return Reason("StuckValue", text, f"check the {name} sensor or the object's mapping")


def _find_demand_jump(signals: WindowSignals, demand: Float) -> Iterator[Reason]:
    window = signals.window
    speed_mm_s = float(np.abs(smooth_samples(window.speed_rad_s, window.dt_s)).max()) * window.pitch_mm / (2 * math.pi)
    steps = np.abs(np.diff(interpolate_gaps(demand)))
    row = int(np.argmax(steps))
    if steps[row] > speed_mm_s * max(LONGEST_CYCLE_S, 2.0 * window.dt_s) + find_resolution(demand[np.isfinite(demand)]):
        takes = f"the axis takes {1e3 * steps[row] / speed_mm_s:.0f} ms for that" if speed_mm_s else "the speed is zero"
        jump = f"demand jumps by {steps[row]:.4g} mm at {signals.get_time_s(row):.3f} s"
        text = f"{jump}, as after a pause or lost samples: {takes}"
        yield Reason("StuckValue", text, "check where the demand is recorded, or the object's mapping")


def find_copied_signals(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason for each two signals of which one is the other times a constant in every row."""
    begin, end = signals.motion_range
    moving = {
        name: fill_forward(values)[begin:end] for name, values in collect_recorded_signals(signals.window).items()
    }
    for (one, values), (other, others) in combinations(moving.items(), 2):
        power = float(others @ others)
        if values.size < LEAST_SAMPLES or np.ptp(values) == 0.0 or not 0.0 < power < math.inf:
            continue
        factor = float(values @ others) / power
        if np.abs(values - factor * others).max() <= SAME * np.abs(values).max():
            text = f"{one} and {other} are the same signal: in every sample {one} is {factor:.6g} times {other}"
            yield Reason("Implausible", text, "correct which column or object is which signal")


def find_unrelated_signals(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason for voltage and current if speed and acceleration explain too little of them."""
    window = signals.window
    begin, end = signals.motion_range
    speed = smooth_samples(window.speed_rad_s, window.dt_s)
    motion = np.stack([np.ones(window.n), speed, np.gradient(speed, window.dt_s)])
    followed = {k: v for k, v in collect_recorded_signals(window).items() if k in LEAST_FOLLOWED}
    parts = {name: (motion[:, begin:end], smooth_samples(v, window.dt_s)[begin:end]) for name, v in followed.items()}
    slow = window.slow_voltage
    if slow is not None:
        rows = slow.begin_s / window.dt_s + (np.arange(slow.voltage_v.size) + 0.5) * slow.period_s / window.dt_s
        known = np.isfinite(slow.voltage_v) & (rows >= begin) & (rows < end)
        courses = [np.interp(rows[known], np.arange(window.n), course) for course in motion]
        parts["voltage"] = np.stack(courses), slow.voltage_v[known]
    for name, (courses_of_motion, values) in parts.items():
        share = _compute_explained_share(values, courses_of_motion)
        if share < LEAST_FOLLOWED[name]:
            text = (
                f"{name} does not follow the speed: speed and acceleration explain {max(0.0, share):.0%} of it, in "
                f"any rapid {LEAST_FOLLOWED[name]:.0%} at least"
            )
            yield Reason("Implausible", text, f"check which column or object is the {name}, and of which axis it is")


def _compute_explained_share(values: Float, courses: Float) -> float:
    """Return the share of the variance of ``values`` (m,) that ``courses`` (q, m) explain; 1 if they are constant."""
    size = values.size
    variance = float(np.var(values)) if size >= LEAST_SAMPLES else 0.0
    scale = np.abs(courses).max(axis=1, keepdims=True) if size else np.ones((len(courses), 1))
    if not 0.0 < variance < math.inf or not (scale > 0.0).all():
        return 1.0
    columns = (courses / scale).T
    weights, _ = solve_least_squares(columns, values)
    return 1.0 - float(np.mean((values - columns @ weights) ** 2)) / variance


def find_table_sensor_faults(window: Window, moving: tuple[int, int]) -> Mapping[str, Reason]:
    """Return why the sensors at the table are not used, by the window's field: they do not move as the motor does.

    Differences by the screw's deflection or a sensor's delay are below the tolerance, and not a fault.
    """
    rows = slice(*moving)
    found = {}
    if window.table_mm is not None and np.isfinite(window.position_mm).any():
        motor = interpolate_gaps(window.position_mm)[rows]
        difference = (window.table_mm[rows] - motor)[np.isfinite(window.table_mm[rows])]
        apart, travel = float(np.ptp(difference)) if difference.size else 0.0, float(np.ptp(motor))
        if apart > TABLE_MM + TABLE_SHARE * travel:
            text = f"table sensor and position differ by {apart:.4g} mm over {travel:.4g} mm of travel: not used"
            found["table_mm"] = Reason("Implausible", text, "check the table sensor, its scale, sign and axis")
    if window.table_m_s2 is not None:
        known = np.isfinite(window.table_m_s2[rows])
        readings = window.table_m_s2[rows][known]
        speed = smooth_samples(window.speed_rad_s, window.dt_s)
        own = np.gradient(speed, window.dt_s)[rows][known] * window.pitch_mm / (2e3 * math.pi)
        if readings.size >= LEAST_SAMPLES and not np.ptp(readings) > 0.0:
            text = f"table acceleration is constant at {readings[0]:.4g} m/s2: it is not used"
            found["table_m_s2"] = Reason("StuckValue", text, "check the accelerometer")
        elif readings.size >= LEAST_SAMPLES and float(np.var(own)) > 0.0:
            courses = np.stack([np.ones(readings.size), own])
            gain = float(solve_least_squares(courses.T, readings)[0][1])
            if _compute_explained_share(readings, courses) > TABLE_FOLLOWS and not 1.0 / TABLE_GAIN < gain < TABLE_GAIN:
                text = f"table acceleration is {gain:.3g} times that of the motor: it is not used"
                found["table_m_s2"] = Reason("CalibrationSuspect", text, "check the accelerometer's scale and sign")
    return found


def is_confirmed_by_position(window: Window, signal: SensorSignal, start: int, end: int) -> bool:
    """Return whether the position moves as by the speed that repeats one reading in rows ``start`` to ``end`` - 1.

    A quantised speed may be half a step from its reading, and the position one of its own.
    """
    position = window.position_mm[start:end]
    known = np.isfinite(position)
    if signal.name != "speed" or np.count_nonzero(known) < 3 or np.ptp(position[known]) == 0.0:
        return False
    to_mm = window.pitch_mm / (2 * math.pi) * window.dt_s
    rows = np.flatnonzero(known) - np.flatnonzero(known)[0]
    error_mm = position[known] - position[known][0] - signal.values[start] * to_mm * rows
    steps = QUANTISATION_STEPS * find_resolution(window.position_mm[np.isfinite(window.position_mm)])
    return bool((np.abs(error_mm) <= signal.step / 2 * to_mm * rows + steps).all())


def explain_missing_move(recording: Recording) -> Reason | None:
    """Return which signal hides the rapids of a recording in which none was found; None where there is no move."""
    position = recording.position_mm[np.isfinite(recording.position_mm)]
    speed = recording.speed_rad_s
    if position.size < 2 or not np.isfinite(speed).any():
        return None
    travel = integrate_travel_mm(speed, recording.dt_s, recording.pitch_mm)
    moved, integral = float(np.ptp(position)), float(np.ptp(travel))
    if max(moved, integral) < STILL_MM or abs(moved - integral) < 0.1 * max(moved, integral):
        return None
    top = float(np.abs(smooth_samples(speed, recording.dt_s)).max())
    text = f"speed reaches {top:.3g} rad/s and its integral {integral:.3g} mm, the position travels {moved:.4g} mm"
    return Reason("Implausible", text, "check the sensor, the unit and the mapping of speed and position")
