"""Checks the signals before any fit: finite, not clipped, no hidden gap."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from fdhil.identification import fill_forward, find_longest_run, find_resolution, interpolate_gaps
from fdhil.records import Float, Reason, Window
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.repeated_readings import is_beyond_chance
from fdhil.validation.signal_consistency import integrate_travel_mm, is_confirmed_by_position
from fdhil.validation.window_signals import STILL_MM, WindowSignals, collect_sensors

TOLERATED_GAP = 3  # rows: a longer gap hides what the drive did
TOLERATED_LOSS = 0.02
RAIL_SAMPLES = 3
QUANTISATION = 1 / 50
SCALE_TOLERANCE = 0.005  # of the travel: tolerance of pitch and speed scale
ELASTIC_UM = 60.0  # a screw's wind-up, and backlash too small to detect


# travel of the position per travel of the integral of speed, and the unit error that causes it
UNITS_MISTAKEN: Mapping[float, str] = {
    1e3: "as if the position were in mm instead of m",
    1e6: "as if the position were in um instead of m",
    1e3 / 25.4: "as if the position were in inches instead of m",
    1e-3: "as if the screw pitch were in mm instead of m, or times in ms instead of s",
    math.pi / 30: "as if the speed were in 1/min instead of rad/s",
    math.pi / 180: "as if the speed were in degrees per second instead of rad/s",
    -1.0: "as if position and speed had opposite signs",
}
UNIT_TOLERANCE = 0.02
HOTTEST_C = 120.0  # above any slide-way, screw or winding in service


def collect_signal_warnings(window: Window) -> list[Reason]:
    """Return warnings that do not refuse the window: coarse quantisation, an implausible temperature."""
    found = []
    for signal in collect_sensors(window):
        finite = signal.values[np.isfinite(signal.values)]
        span, step = float(np.ptp(finite)) if finite.size else 0.0, signal.step
        if span > 0 and step > QUANTISATION * span:
            text = f"{signal.name} has steps of {step:.3g} {signal.unit}, {100 * step / span:.1f} % of the range used"
            found.append(Reason("Quantised", text, "use a finer scale in the drive's mapping"))
    if window.temperature_c is not None and not -HOTTEST_C < window.temperature_c < HOTTEST_C:
        text = f"{window.temperature_c:g} degC is not a plausible machine temperature"
        celsius = window.temperature_c - 273.15
        text += f"; {celsius:.0f} degC in kelvin?" if -50.0 < celsius < HOTTEST_C else ""
        found.append(Reason("Implausible", text, "give temperature_C in degrees Celsius: drift is compared with it"))
    return found


def find_invalid_values(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason for each signal with values that are not finite, and for one that no drive reaches."""
    lost, largest = np.zeros(signals.window.n, dtype=bool), 0.0
    for begin, end in signals.window.gaps:
        lost[begin:end] = True
    for signal in signals.sensors:
        finite = np.isfinite(signal.values)
        largest = max(largest, float(np.abs(signal.values[finite]).max(initial=0.0)))
        bad = ~finite & ~lost
        if bad.any():
            first = signals.get_time_s(int(np.argmax(bad)))
            text = f"{signal.name} is not finite in {int(bad.sum())} rows, first at {first:.3f} s"
            yield Reason("NotFinite", text, "check the sensor and its scaling")
    if largest > 1e9:
        yield Reason("NotFinite", f"a signal reaches {largest:.3g}, beyond any drive", "check the scaling")


def find_missing_stages(window: Window) -> Iterator[Reason]:
    """Yield a reason if the move does not begin or end at rest."""
    stages = window.stages
    for name, stage in (("accel", stages.accelerate), ("brake", stages.brake)):
        if stage is None:
            what = {"accel": "acceleration", "brake": "braking to rest"}[name]
            yield Reason(f"MissingStage({name})", f"the move has no {what}", "record the whole of a longer rapid")


def check_plateau(window: Window) -> Iterator[Reason]:
    """Yield a reason if the speed is never constant: only noise then separates friction from inertia."""
    if window.stages.cruise is None:
        text = "the move has no 100 ms of constant speed"
        yield Reason("MissingStage(cruise)", text, "record the whole of a longer rapid")


def find_gaps(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason if more of the move is lost than a fit may skip."""
    window, (a, b) = signals.window, signals.motion_range
    inside = [(g, h) for g, h in window.gaps if (g < b and h > a) or _has_motion_in_gap(window, g, h)]
    rows = sum(h - g for g, h in inside)
    if rows and (max(h - g for g, h in inside) > TOLERATED_GAP or rows > TOLERATED_LOSS * (b - a)):
        text = f"{rows} of {b - a} samples of the move are lost, the first at {signals.get_time_s(inside[0][0]):.3f} s"
        yield Reason("StaleData", text, "find where frames are lost: bus load, receive buffer")


def _has_motion_in_gap(window: Window, begin: int, end: int) -> bool:
    """Return whether the table moves while these rows are lost: the end of the move may lie within them."""
    edges = window.position_mm[[max(0, begin - 1), min(end, window.n - 1)]]
    return bool(abs(edges[1] - edges[0]) > STILL_MM)


def find_clipped_signals(signals: WindowSignals) -> Iterator[Reason]:
    """Yield a reason for each extreme at which a signal stays longer than its own samples explain."""
    for signal in signals.varying_sensors:
        values = signal.values
        if not np.isfinite(values).any():
            continue
        for rail, side in ((np.nanmax(values), "upper"), (np.nanmin(values), "lower")):
            start, end = find_longest_run(values == rail)
            if rail == 0.0 or end - start < RAIL_SAMPLES or not is_beyond_chance(values, start, end - 1):
                continue
            if is_confirmed_by_position(signals.window, signal, start, end):
                continue
            text = (
                f"{signal.name} stays at its {side} extreme {rail:.6g} {signal.unit} for {end - start} samples "
                f"from {signals.get_time_s(start):.3f} s"
            )
            yield Reason("Saturated", text, "use a larger measuring range")


def compare_position_with_speed(signals: WindowSignals) -> Iterator[Reason]:
    """Compare the position with the integral of speed: a hidden gap, a stuck signal or a wrong scale shows up.

    Both may differ by the backlash that the window shows.
    """
    window, play = signals.window, signals.backlash
    if not np.isfinite(window.position_mm).any() or np.ptp(fill_forward(window.position_mm)) == 0.0:
        return
    # lost rows are interpolated for this comparison alone
    position, travel = (
        interpolate_gaps(window.position_mm),
        integrate_travel_mm(window.speed_rad_s, window.dt_s, window.pitch_mm),
    )
    to_mm = window.dt_s * window.pitch_mm / (2 * math.pi)
    noise = signals.noise.speed_rad_s * to_mm
    rounding = find_resolution(window.speed_rad_s[np.isfinite(window.speed_rad_s)]) / 2 * to_mm
    quantum = max(find_resolution(position), 1e-6)
    error = position - position[0] - travel
    unit = _identify_unit_error(travel, error)
    if unit is not None:
        yield unit
        return
    elastic = 1e-3 * (ELASTIC_UM + 1.5 * (play.um if play is not None else 0.0))
    yield from _find_position_jump(signals, error, noise, quantum, elastic, rounding)
    yield from _check_scale(travel, error, noise, quantum, elastic + rounding * error.size)


def _find_position_jump(
    signals: WindowSignals, error: Float, noise: float, quantum: float, elastic: float, rounding: float
) -> Iterator[Reason]:
    """Find the interval, up to 100 ms long, over which position and integral differ most beyond noise.

    A quantised speed may be off by ``rounding`` mm in each sample, always to one side.
    """
    worst, where, amount = 0.0, 0, 0.0
    for seconds in (0.0, 0.005, 0.02, 0.05, 0.1):
        length = max(1, round(seconds / signals.window.dt_s))
        if length >= error.size:
            continue
        change = np.abs(error[length:] - error[:-length])
        allowed = BUDGET["position"].deviations * np.hypot(noise * np.sqrt(length + 1), quantum) + elastic
        allowed += rounding * length
        k = int(np.argmax(change))
        if change[k] / allowed > worst:
            worst, where, amount = float(change[k] / allowed), k, float(change[k])
    if worst > 1.0:
        at = f"at {signals.get_time_s(where):.3f} s"
        text = f"position and the integral of speed differ by {1e3 * amount:.0f} um {at}"
        yield Reason("Implausible", text, "samples are lost or repeated there: check counters and time stamps")


def _identify_unit_error(travel: Float, error: Float) -> Reason | None:
    whole = float(travel[-1])
    times = 1.0 + float(error[-1]) / whole if whole else 1.0
    for factor, meaning in UNITS_MISTAKEN.items():
        if abs(times / factor - 1.0) < UNIT_TOLERANCE:
            text = f"the position travels {times:.4g} times the integral of speed, {meaning}"
            return Reason("CalibrationSuspect", text, "correct the unit where the recording is made")
    return None


def _check_scale(travel: Float, error: Float, noise: float, quantum: float, elastic: float) -> Iterator[Reason]:
    whole = abs(float(travel[-1]))
    chance = BUDGET["position"].deviations * np.hypot(noise * np.sqrt(error.size), quantum)
    allowed = chance + SCALE_TOLERANCE * whole + elastic
    if whole > 0 and abs(float(error[-1])) > allowed:
        share = 100 * float(error[-1]) / whole
        text = f"the position travels {share:+.2f} % more than the integral of speed"
        yield Reason("CalibrationSuspect", text, "check the screw's pitch, the speed scale and lost samples")
