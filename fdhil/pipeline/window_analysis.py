"""Analyses one window: align signals, check signals, estimate, check the fit, assess the error at the table."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification import (
    MAXIMUM_LIKELIHOOD,
    LikelihoodFit,
    align_demand_to_drive,
    align_speed_to_samples,
    build_estimate,
    build_torque_estimate,
    check_configured_resonance,
    create_empty_estimate,
    estimate_compliance,
    fit_windows,
    fit_with_compliance,
    merge_compliance,
    refit_with_loops,
    select_estimator,
)
from fdhil.identification import fit_torque as fit_torque
from fdhil.records import Estimate, Parameters, Reason, Result, Verdict, Window, WindowOutcome
from fdhil.validation import (
    FIT_CHECKS,
    LEAST_SAMPLES,
    PLATEAU,
    SIGNAL_CHECKS,
    STUCK_SENSOR,
    WEIGHED,
    Findings,
    TableAssessment,
    WindowFit,
    WindowSignals,
    detect_gain_error,
    detect_scale_convention,
    find_table_sensor_faults,
    measure_table_error,
    run_checks,
)

# errors of solvers; scipy's raise ValueError for values that are not finite
GAVE_UP = (np.linalg.LinAlgError, FloatingPointError, ZeroDivisionError, OverflowError, ValueError)
SAME_PITCH = 0.01  # tolerance between a recording and its axis' section
OVERRIDE = 2.0  # factor by which their rapid speeds may differ: an override slows the recorded move
NOTICED = 0.2  # of the allowed residual: below, no resonance is searched for
UNFIT = "NotFinite"
KEPT_FITS = 12  # of the newest windows: a recording's rapids, or those that identify a drive's loops
LAG_ROWS = 0.75  # a speed that is a difference of positions is half a row late


def analyse_window(
    window: Window, settings: Identification, axis: Axis | None = None, sync_period_s: float | None = None
) -> WindowOutcome:
    """Return the estimate and verdict of one window; never raises, whatever the data.

    The speed is aligned to its rows first; the outcome's window is as it was recorded. With the ``axis``' section the
    rapid is replayed through the closed loop, whose set-points come every ``sync_period_s`` (default: every row).
    """
    axis = select_matching_axis(window, axis)
    aligned, cycles = align_demand_to_drive(align_speed_to_samples(window, settings.speed_source), axis, sync_period_s)
    signals = WindowSignals(aligned, settings, axis, sync_period_s, recorded=window)
    outcome = replace(_apply_table_sensors(_run_analysis(signals), signals), window=window)
    return _warn_demand_lead(outcome, cycles) if cycles else outcome


def _warn_demand_lead(outcome: WindowOutcome, cycles: int) -> WindowOutcome:
    text = f"the recorded set-point is {cycles} cycles ahead of the one that the drive follows, and was delayed by that"
    reason = Reason("SampleTiming", text, "record the drive's own set-point, or ignore this: it has no other effect")
    verdict = replace(outcome.verdict, warnings=(*outcome.verdict.warnings, reason))
    return replace(outcome, verdict=verdict)


def _apply_table_sensors(outcome: WindowOutcome, signals: WindowSignals) -> WindowOutcome:
    """Return the outcome with the results of sensors at the table: the true error, and a resonance.

    Such a resonance replaces a configured one, or one seen by the motor, and the window is analysed with it. A sensor
    that does not move as the motor does is left out, with a warning.
    """
    window, estimate, axis = signals.window, outcome.estimate, signals.axis
    if estimate is None or (window.table_mm is None and window.table_m_s2 is None):
        return outcome
    with np.errstate(over="ignore", invalid="ignore"):
        faults = find_table_sensor_faults(window, signals.motion_range)
    if faults:
        place = None if "table_mm" in faults else window.table_mm
        rate = None if "table_m_s2" in faults else window.table_m_s2
        signals = replace(signals, window=replace(window, table_mm=place, table_m_s2=rate))
        warnings = (*outcome.verdict.warnings, *faults.values())
        return _apply_table_sensors(replace(outcome, verdict=replace(outcome.verdict, warnings=warnings)), signals)
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            found = estimate_compliance(window, estimate.build_parameters())
    except GAVE_UP:  # signals that are no table's motion
        found = None
    if found is not None:
        if axis is not None:
            outcome = _run_analysis(replace(signals, axis=axis.model_copy(update=found.get_config_values())))
        warnings = (*outcome.verdict.warnings, *check_configured_resonance(found, axis))
        estimate = merge_compliance(outcome.estimate or estimate, found)
        outcome = replace(outcome, estimate=estimate, verdict=replace(outcome.verdict, warnings=warnings))
    seen = measure_table_error(window, estimate.build_parameters(), axis, signals.sync_period_s)
    return outcome if seen is None else replace(outcome, at_table=seen)


def _run_analysis(signals: WindowSignals) -> WindowOutcome:
    window, settings = signals.window, signals.settings
    found = run_checks(SIGNAL_CHECKS, signals, {})
    reasons = [reason for each in found.values() for reason in each]
    if window.n < LEAST_SAMPLES or any(reason.code == UNFIT for reason in reasons):
        return _build_outcome(
            TableAssessment(WindowFit(signals, _build_empty_estimate(settings, Result.NOT_FINITE, reasons[0]))), found
        )
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            fitted = estimate_window(signals)
            table = TableAssessment(fitted)
            return _build_outcome(table, run_checks(FIT_CHECKS, table, found))
    except GAVE_UP as error:
        reason = build_solver_reason(error, "inspect the window's signals")
        # the checks of each sensor's own rows remain valid
        found = {**found, "solver": [reason]}
        found = run_checks((STUCK_SENSOR,), TableAssessment(WindowFit(signals)), found)
        return _build_outcome(
            TableAssessment(WindowFit(signals, _build_empty_estimate(settings, Result.DIVERGED, reason))), found
        )


def select_matching_axis(window: Window, axis: Axis | None) -> Axis | None:
    """Return the axis' section if it can be that of the window: the regulators of another machine are unknown."""
    if axis is None:
        return None
    pitch, rapid = window.pitch_mm / axis.screw_pitch_mm, window.rapid_speed_rad_s / axis.rapid_speed_rad_s
    return axis if abs(pitch - 1.0) < SAME_PITCH and 1.0 / OVERRIDE <= rapid <= OVERRIDE else None


def estimate_window(signals: WindowSignals) -> WindowFit:
    """Return the estimate by the configured method, with the fit that is checked.

    Without a voltage [2] alone is fitted, with the torque constant of the recording or of the axis: there is no fit of
    both equations.
    """
    window, settings, axis = signals.window, signals.settings, signals.axis
    if not signals.has_voltage:
        torque = fit_torque(window, settings)
        known = {} if axis is None else {"R": axis.nominal.R, "L": axis.nominal.L, "K": axis.nominal.K}
        return WindowFit(signals, build_torque_estimate(window, torque, known), torque=torque)
    name, estimator = select_estimator(settings)
    fit = _fit_window(window, settings)
    if fit is not None and axis is not None:
        fit = refit_with_loops(fit, window, settings, axis, signals.sync_period_s)
    if name == MAXIMUM_LIKELIHOOD and fit is not None:
        return _fit_compliance(WindowFit(signals, build_estimate(fit), fit))
    return WindowFit(signals, estimator([window], settings), fit)


@lru_cache(maxsize=KEPT_FITS)
def _fit_window(window: Window, settings: Identification) -> LikelihoodFit | None:
    """Return the fit of a window, the same for each section of the axis with which it is analysed."""
    return fit_windows([window], settings)


def _fit_compliance(stiff: WindowFit) -> WindowFit:
    """Return the fit with a spring between motor and table, if one explains the rapid as well.

    An unconfigured one is searched for only where the regulators are unknown; else replays of rapids find it, better
    than one window's speed.
    """
    assert stiff.fit is not None
    axis, weight = stiff.signals.axis, TableAssessment(stiff).budget
    if weight is None or (axis is not None and axis.resonance_hz is None):
        return stiff
    if axis is None and weight.unexplained_um < NOTICED * weight.limit_um:
        return stiff
    found = fit_with_compliance(stiff.fit, axis)
    if found is None:
        return stiff
    soft = WindowFit(stiff.signals, build_estimate(found), found)
    budget = TableAssessment(soft).budget
    left = math.inf if budget is None else budget.unexplained_um
    return soft if left < max(weight.limit_um, weight.unexplained_um) else stiff


def build_solver_reason(error: BaseException, advice: str) -> Reason:
    """Return the reason of a solver that failed with an error."""
    return Reason("SolverFailed", f"the solver failed ({error})", advice)


def _build_empty_estimate(settings: Identification, result: Result, reason: Reason) -> Estimate:
    return create_empty_estimate(select_estimator(settings)[0], result, reason)


def _check_speed_lag(window: Window) -> Reason | None:
    late = window.speed_late_s
    if late is None or late < LAG_ROWS * window.dt_s:
        return None
    text = f"speed was shifted {1e3 * late:.2f} ms earlier to match the position, unless the position is early by that"
    return Reason("SampleTiming", text, "take speed and position from one SYNC, or set [identification] speed_source")


def _build_outcome(table: TableAssessment, found: Findings) -> WindowOutcome:
    """Return the verdict: weighed findings refuse only if they do harm at the table, and warn else."""
    weight, fitted = table.budget, table.fitted
    axis, estimate = table.signals.axis, fitted.estimate
    nominal = None if axis is None else Parameters(**axis.nominal.model_dump())
    names = WEIGHED | {PLATEAU} if weight is not None and weight.through == "replay" else WEIGHED
    weighed = [r for name, each in found.items() if name in names for r in each]
    reasons = [r for name, each in found.items() if name not in names for r in each]
    # an ordinary loop gives only a share: named reasons are more specific
    if weight is not None and not weight.is_met and (weight.is_absolute or not (reasons or weighed)):
        reasons.append(weight.build_reason())
        if nominal is not None and estimate is not None and (gain := detect_gain_error(estimate, nominal)) is not None:
            reasons.append(gain)
    if not table.is_harmless:
        reasons, weighed = [*reasons, *weighed], []
    if reasons and (lag := _check_speed_lag(fitted.window)) is not None:
        reasons.append(lag)
    if nominal is not None and estimate is not None and not estimate.missing:
        scale = detect_scale_convention(estimate, nominal)
        reasons += [] if scale is None else [scale]
    unexplained = weight.unexplained_um if weight is not None and weight.is_absolute else None
    verdict = Verdict(not reasons, fitted.fit_percent, tuple(reasons), unexplained, tuple(weighed))
    return WindowOutcome(fitted.window, fitted.widened_estimate, verdict)
