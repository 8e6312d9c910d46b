"""The signals of one rapid with the model's, their residuals, and the spectra of both. Pure."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from fdhil.identification import find_moving_range, interpolate_gaps
from fdhil.pipeline import ModelOverlay
from fdhil.records import Float, Reason, Window, compute_rms
from fdhil.report import typeset_text
from fdhil.web.pages.rapid_list import Said

MOST_POINTS = 6000
"""Points of one curve: more than a screen shows, and few enough for a browser on a phone."""

Points = list[float | None]


class Signal(BaseModel):
    """A signal in the unit that its name ends with: measured, modelled, and the residual; null if unknown.

    ``model`` is the source of the modelled one: "voltage" (the drive under the measured voltage alone), "loop" (the
    closed loop along the demand), or null. ``residual_rms`` is over the move. The spectra are amplitudes.
    """

    name: str
    unit: str
    shown_unit: str
    model: str | None
    measured: Points
    modelled: Points | None
    residual: Points | None
    residual_rms: float | None
    measured_spectrum: Points
    residual_spectrum: Points | None


class Replayed(BaseModel):
    """The verdict of a replay of the recording with the present configuration."""

    accepted: bool
    fit_percent: float | None
    unexplained_um: float | None
    reasons: list[Said]
    warnings: list[Said]


class Stage(BaseModel):
    """A stage of the move: "accelerate", "cruise" or "brake"."""

    name: str
    begin_s: float
    end_s: float


class RapidSignals(BaseModel):
    """A rapid's signals: point k is ``time_s[k]`` after the first row; of long ones only each ``every``-th row.

    ``turns_hz`` is the motor's highest frequency of rotation, where effects of each turn appear.
    """

    every: int
    time_s: list[float]
    move_begin_s: float
    move_end_s: float
    stages: list[Stage]
    direction: int
    turns_hz: float
    frequency_hz: list[float]
    signals: list[Signal]
    replayed: Replayed


@dataclass(frozen=True, slots=True, eq=False)
class _SignalCurve:
    """A signal (n,) with its name and unit, and the curve (n,) of a model."""

    name: str
    unit: str
    measured: Float
    modelled: Float | None = None
    model: str | None = None


def make_rapid_signals(overlay: ModelOverlay) -> RapidSignals:
    """Return the signals of a rapid with its model."""
    window = overlay.window
    begin, end = find_moving_range(window)
    every = max(1, -(-window.n // MOST_POINTS))
    frequency = np.fft.rfftfreq(window.n, window.dt_s)
    verdict = overlay.outcome.verdict
    return RapidSignals(
        every=every,
        time_s=round_digits(np.arange(0, window.n, every) * window.dt_s, 9),
        move_begin_s=begin * window.dt_s,
        move_end_s=end * window.dt_s,
        stages=_list_stages(window),
        direction=window.direction,
        turns_hz=float(np.nanmax(np.abs(window.speed_rad_s), initial=0.0)) / (2.0 * math.pi),
        frequency_hz=round_digits(frequency[:: _choose_step(frequency.size)], 9),
        signals=[_make_signal(course, slice(begin, end), every) for course in _list_curves(overlay)],
        replayed=Replayed(
            accepted=verdict.accepted,
            fit_percent=verdict.fit_percent,
            unexplained_um=verdict.unexplained_um,
            reasons=[_make_reason(reason) for reason in verdict.reasons],
            warnings=[_make_reason(warning) for warning in verdict.warnings],
        ),
    )


def _list_stages(window: Window) -> list[Stage]:
    spans = ((name, getattr(window.stages, name)) for name in ("accelerate", "cruise", "brake"))
    return [Stage(name=n, begin_s=s[0] * window.dt_s, end_s=s[1] * window.dt_s) for n, s in spans if s is not None]


def _make_reason(reason: Reason) -> Said:
    return Said(code=reason.code, text=typeset_text(reason.text), advice=typeset_text(reason.advice))


def _list_curves(overlay: ModelOverlay) -> list[_SignalCurve]:
    """Return the rapid's signals in reading order: cause, response, error."""
    window = overlay.window
    speed, current, model = _select_model(overlay)
    courses = [
        *_make_voltage_curve(window),
        _SignalCurve("current_a", "A", window.current_a, current, model),
        _SignalCurve("speed_rad_s", "rad/s", window.speed_rad_s, speed, model),
    ]
    followed = overlay.followed
    predicted = None if followed is None else 1e3 * (followed.predicted_mm - window.demand_mm)
    error = 1e3 * (window.position_mm - window.demand_mm)
    if np.isfinite(error).any():
        courses.append(_SignalCurve("following_error_um", "um", error, predicted, None if followed is None else "loop"))
    if window.offset_mm is not None:
        courses.append(_SignalCurve("offset_um", "um", 1e3 * window.offset_mm))
    if window.table_mm is not None:
        courses.append(_SignalCurve("table_error_um", "um", 1e3 * (window.table_mm - window.demand_mm)))
    return courses


def _select_model(overlay: ModelOverlay) -> tuple[Float | None, Float | None, str | None]:
    """Return speed and current (n,) from the measured voltage, else from the closed loop."""
    window, driven, followed = overlay.window, overlay.driven, overlay.followed
    if driven is not None:
        time_s = np.arange(window.n) * window.dt_s
        speed, current = (
            np.interp(time_s, driven.time_s, course, math.nan, math.nan)
            for course in (driven.speed_rad_s, driven.current_a)
        )
        return speed, current, "voltage"
    if followed is not None:
        return followed.response.speed_rad_s, followed.response.current_a, "loop"
    return None, None, None


def _make_voltage_curve(window: Window) -> list[_SignalCurve]:
    """Return the voltage at the window's rows; a slow sensor's value covers its whole period."""
    if window.voltage_v is not None:
        return [_SignalCurve("voltage_v", "V", window.voltage_v)]
    slow = window.slow_voltage
    if slow is None:
        return []
    sample = np.floor((np.arange(window.n) * window.dt_s - slow.begin_s) / slow.period_s).astype(np.int64)
    inside = (sample >= 0) & (sample < slow.voltage_v.size)
    held = np.where(inside, slow.voltage_v[np.clip(sample, 0, slow.voltage_v.size - 1)], math.nan)
    return [_SignalCurve("voltage_v", "V", held)]


def _make_signal(course: _SignalCurve, moving: slice, every: int) -> Signal:
    measured, modelled = course.measured, course.modelled
    residual = None if modelled is None else measured - modelled
    left = np.zeros(0) if residual is None else residual[moving][np.isfinite(residual[moving])]
    return Signal(
        name=course.name,
        unit=course.unit,
        shown_unit=typeset_text(course.unit),
        model=course.model,
        measured=round_digits(measured[::every]),
        modelled=None if modelled is None else round_digits(modelled[::every]),
        residual=None if residual is None else round_digits(residual[::every]),
        residual_rms=compute_rms(left) if left.size else None,
        measured_spectrum=round_digits(compute_spectrum(measured)),
        residual_spectrum=None if residual is None else round_digits(compute_spectrum(residual)),
    )


def compute_spectrum(values: Float) -> Float:
    """Return the amplitudes (m,) of a signal (n,) less its mean: a sine of amplitude 1 makes a peak of 1.

    Uses Hann's window (Harris 1978); lost samples are interpolated. Of adjacent frequencies the largest is kept.
    """
    if not np.isfinite(values).any():
        return np.full(0, math.nan)
    known = interpolate_gaps(np.where(np.isfinite(values), values, math.nan))
    taper = np.hanning(values.size + 1)[:-1]
    amplitude = 2.0 * np.abs(np.fft.rfft((known - known.mean()) * taper)) / max(float(taper.sum()), 1e-300)
    step = _choose_step(amplitude.size)
    padded = np.append(amplitude, np.zeros(-amplitude.size % step))
    peaks: Float = padded.reshape(-1, step).max(axis=1)
    return peaks


def _choose_step(size: int) -> int:
    return max(1, -(-size // MOST_POINTS))


def round_digits(values: npt.NDArray[Any], digits: int = 6) -> list[Any]:
    """Return numbers for JSON with so many significant digits; None for non-finite ones."""
    return [float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values.tolist()]
