"""Draws the paper's figures as inline SVG from records.

Figure numbers in the docstrings are those of [DES] (Desforges, Habbadi, Dessein). Paths are drawn by the maps module,
whose functions are offered here too.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from fdhil.model import simulate_plant
from fdhil.records import Float, Parameters, Window, compute_rms
from fdhil.report.chart import MOST_POINTS, Chart, Panel, Trace, render_svg
from fdhil.report.path_maps import (
    TALL,
    Curve,
    MapPosition,
    draw_error_map,
    draw_path,
    draw_path_detail,
    magnify_deviation,
)
from fdhil.report.svg_drawing import COLOURS, INK, REFERENCE

__all__ = [
    "COLOURS",
    "FAR_APART",
    "INK",
    "LEAST_UM",
    "REFERENCE",
    "TALL",
    "Curve",
    "MapPosition",
    "draw_axis_errors",
    "draw_contour_errors",
    "draw_drift",
    "draw_error_map",
    "draw_model_comparison",
    "draw_path",
    "draw_path_detail",
    "draw_signals",
    "draw_torque",
    "find_common_scale",
    "is_log_scale_needed",
    "magnify_deviation",
    "simulate_speed",
]  # fmt: skip

FAR_APART = 20.0  # errors that differ by more need a logarithmic scale
LEAST_UM = 0.01
RESIDUAL_SHARE = 0.42  # of the height of the panel above


def draw_signals(window: Window) -> str:
    """Draw measured voltage, current and speed of one rapid (Figure 4)."""
    time_s = _compute_time_s(window)
    traces = [
        Trace("current (A)", time_s, window.current_a, COLOURS[2]),
        Trace("speed (rad/s)", time_s, window.speed_rad_s, COLOURS[0]),
    ]
    if window.voltage_v is not None:
        traces.insert(0, Trace("voltage (V)", time_s, window.voltage_v, COLOURS[1]))
    peak = ", ".join(f"{trace.label} up to {np.nanmax(np.abs(trace.y)):.3g}" for trace in traces)
    alt = f"Axis {window.axis}, one rapid move of {time_s[-1]:.2f} s: {peak}."
    return render_svg(Chart("time (s)", [Panel("V, A, rad/s", traces)], alt))


def _compute_time_s(window: Window) -> Float:
    return np.asarray(np.arange(window.n) * window.dt_s, dtype=np.float64)


def draw_torque(cases: Sequence[tuple[str, Window, Parameters]]) -> str:
    """Draw the estimated torque Jt dw/dt + ft w + Cd sign(w) of rapids at several temperatures (Figure 5)."""
    traces = []
    for (label, window, parameters), colour in zip(cases, COLOURS, strict=False):
        speed = simulate_speed(window, parameters)
        estimated = (
            parameters.Jt * np.gradient(speed, window.dt_s) + parameters.ft * speed + parameters.Cd * np.sign(speed)
        )
        traces.append(Trace(label, _compute_time_s(window), estimated, colour))
    words = "; ".join(f"{t.label}: {np.median(np.abs(t.y)):.3g} N.m in the middle" for t in traces)
    return render_svg(Chart("time (s)", [Panel("torque (N.m)", traces)], f"Torque of a rapid move. {words}."))


def simulate_speed(window: Window, parameters: Parameters) -> Float:
    """Return the shaft speed (n,), rad/s, simulated from the measured voltage; without a voltage the measured speed."""
    if window.voltage_v is None:
        return window.speed_rad_s
    voltage = np.nan_to_num(window.voltage_v)
    _, speed = simulate_plant(parameters, voltage, window.dt_s, window.voltage_sampling)
    return speed


def draw_drift(symbol: str, unit: str, series: Mapping[str, tuple[Float, Float, Float]]) -> str:
    """Draw a parameter against slide-way temperature with two-sigma bars (Figures 6 and 7).

    ``series`` maps an axis to (temperature_c, value, standard deviation), each (n,).
    """
    traces, words = [], []
    for (label, (celsius, value, std)), colour in zip(series.items(), COLOURS, strict=False):
        traces.append(Trace(label, celsius, value, colour, "points", value - 2 * std, value + 2 * std))
        if celsius.size > 2 and np.ptp(celsius) > 0:
            slope, start = np.polyfit(celsius, value, 1)
            span = np.array([celsius.min(), celsius.max()])
            per_kelvin = f"{slope:+.3g} {unit} per kelvin"
            traces.append(Trace(f"{label}: {per_kelvin}", span, start + slope * span, colour, "dashed"))
            words.append(f"axis {label} {per_kelvin}")
    alt = f"{symbol} over the slide-way's temperature: {'; '.join(words) or 'no slope can be determined'}."
    chart = Chart("temperature of the slide-ways (degC)", [Panel(f"{symbol} ({unit})", traces)], alt)
    return render_svg(chart, 4.8, 3.2)


def draw_model_comparison(window: Window, parameters: Parameters, fit_percent: float | None) -> str:
    """Draw measured and simulated speed, and their difference below (Figure 8)."""
    time_s = _compute_time_s(window)
    fit = "" if fit_percent is None else f", fit {fit_percent:.2f} %"
    answer = simulate_speed(window, parameters)
    difference = window.speed_rad_s - answer
    left = compute_rms(difference[np.isfinite(difference)])
    overlay = [
        Trace("drive, measured", time_s, window.speed_rad_s, REFERENCE, "wide"),
        Trace(f"model{fit}", time_s, answer, COLOURS[1]),
    ]
    panels = [
        Panel("speed (rad/s)", overlay),
        Panel("difference (rad/s)", [Trace("drive less model", time_s, difference, INK)], RESIDUAL_SHARE),
    ]
    alt = f"Axis {window.axis}: measured speed and the model's{fit}; they differ by {left:.2g} rad/s RMS."
    return render_svg(Chart("time (s)", panels, alt), 6.4, 4.2)


def is_log_scale_needed(errors_um: Sequence[Float]) -> bool:
    """Whether the errors differ too much for one linear scale."""
    largest = [float(error_um.max()) for error_um in errors_um]
    return max(largest) > FAR_APART * max(min(largest), LEAST_UM)


def find_common_scale(errors_um: Sequence[Float]) -> tuple[float, float | None]:
    """Return one colour scale for maps to be compared: its largest value, and its least where it is logarithmic."""
    largest = max(float(error_um.max()) for error_um in errors_um)
    if not is_log_scale_needed(errors_um):
        return largest, None
    smaller = min(errors_um, key=lambda error_um: float(error_um.max()))
    return largest, max(LEAST_UM, float(np.median(smaller)))


def draw_contour_errors(dt_s: float, cases: Mapping[str, Float]) -> str:
    """Draw contour errors (um) along the path on a grid of ``dt_s``, one curve a case.

    The scale is logarithmic where one is far smaller than another; long curves are drawn by their largest values.
    """
    log = is_log_scale_needed(list(cases.values()))
    traces = []
    for (label, error_um), colour in zip(cases.items(), COLOURS, strict=False):
        time_s, peaks = _reduce_to_peaks(error_um, dt_s)
        traces.append(Trace(label, time_s, np.maximum(peaks, LEAST_UM) if log else peaks, colour))
    words = "; ".join(
        f"{label} {compute_rms(error):.3g} um RMS, {error.max():.3g} um at most" for label, error in cases.items()
    )
    panel = Panel("contour error (um)", traces, log=log, from_zero=not log)
    return render_svg(Chart("time (s)", [panel], f"Contour error along the path: {words}."), 4.8, 3.2)


def _reduce_to_peaks(values: Float, dt_s: float) -> tuple[Float, Float]:
    per = -(-values.size // MOST_POINTS)
    peaks: Float = np.maximum.reduceat(values, np.arange(0, values.size, per))
    return np.asarray(np.arange(peaks.size) * (per * dt_s)), peaks


def draw_axis_errors(time_s: Float, cases: Mapping[str, Float], axis: str) -> str:
    """Draw the error of one axis over time, um, one curve a case."""
    desired = Trace("desired", time_s[[0, -1]], np.zeros(2), REFERENCE, "wide")
    traces = [Trace(label, time_s, um, colour) for (label, um), colour in zip(cases.items(), COLOURS, strict=False)]
    words = "; ".join(f"{label} {np.abs(um).max():.3g} um at most" for label, um in cases.items())
    panel = Panel(f"{axis} ahead of the desired (um)", [desired, *traces])
    return render_svg(Chart("time (s)", [panel], f"Axis {axis} ahead of the desired: {words}."), 4.8, 3.6)
