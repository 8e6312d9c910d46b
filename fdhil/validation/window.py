"""The verdict on one window: plausible, estimated, physical, of the model's structure, and simulated as measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdhil.config import Identification
from fdhil.identification.delay import coarse_delay
from fdhil.identification.estimators import chosen, least_squares, maximum_likelihood
from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.identifiability import empty_estimate, unphysical, untold
from fdhil.identification.ratios import estimate_ratios
from fdhil.identification.windows import carried
from fdhil.model.feed_drive import discretise, simulate_plant
from fdhil.records import Estimate, Float, Parameters, Reason, Result, Verdict, Window, WindowOutcome
from fdhil.validation.plausibility import implausibilities
from fdhil.validation.rest import rest_faults
from fdhil.validation.slow_fitted import slow_faults_beside
from fdhil.validation.slow_readings import slow_voltage_faults
from fdhil.validation.slow_timing import current_late
from fdhil.validation.structure import findings
from fdhil.validation.stuck import stuck_values
from fdhil.validation.timing import timing_faults
from fdhil.validation.whiteness import excess_noise, whiteness

LEAST_FIT_PERCENT = 80.0
EXCESS = 1.5  # of the variance that noise explains
SHAPE_SHARE = 0.002  # of the rapid speed: what the voltage's course within a sample leaves open
UNFIT = ("NotFinite",)


def analyse(window: Window, settings: Identification) -> WindowOutcome:
    """Return what one window says of the drive, and whether it is believed; never raises, whatever the data."""
    reasons = [*implausibilities(window), *slow_voltage_faults(window)]
    if window.voltage_v is None and window.slow_voltage is None:
        return _without_voltage(window, settings, reasons)
    if window.n < 32 or any(r.code in UNFIT for r in reasons):
        if not reasons:
            reasons.append(Reason("LowExcitation", f"{window.n} rows are no rapid move", "record a whole rapid"))
        missing = empty_estimate(chosen(settings)[0], Result.NOT_FINITE, reasons[0])
        return WindowOutcome(window, missing, Verdict(False, None, tuple(reasons)))
    try:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            estimate, fit = _estimate(window, settings)
            fit_percent = simulated_fit_percent(window, _complete(estimate, fit))
            doubts = [*stuck_values(window, fit), *_doubts(window, estimate, fit, fit_percent, settings)]
            if fit is not None and not any(reason.code in ("StuckValue", "Saturated") for reason in reasons):
                doubts += slow_faults_beside(window, fit, settings.lowpass_hz)
    except (np.linalg.LinAlgError, FloatingPointError, ZeroDivisionError, OverflowError) as error:
        reasons.append(Reason("SolverFailed", f"the solver gave up ({error})", "look at the window's signals"))
        missing = empty_estimate(chosen(settings)[0], Result.DIVERGED, reasons[-1])
        return WindowOutcome(window, missing, Verdict(False, None, (*reasons, *stuck_values(window, None))))
    reasons += doubts
    return WindowOutcome(window, estimate, Verdict(not reasons, fit_percent, tuple(reasons)))


def _without_voltage(window: Window, settings: Identification, reasons: list[Reason]) -> WindowOutcome:
    """Return a refused outcome that still carries Jt/K, ft/K and Cd/K where current and speed are plausible."""
    reasons = [*reasons, Reason("SampleTiming", "the window has no voltage", "connect the voltage sensor")]
    if window.n < 32 or any(reason.code in UNFIT for reason in reasons):
        estimate = empty_estimate(chosen(settings)[0], Result.NOT_FINITE, reasons[0])
    else:
        reasons += stuck_values(window, None)
        estimate = estimate_ratios([window], settings)
    return WindowOutcome(window, estimate, Verdict(False, None, tuple(reasons)))


def _estimate(window: Window, settings: Identification) -> tuple[Estimate, Fit | None]:
    """Return the estimate by the chosen method, and the maximum-likelihood fit that the checks of structure need."""
    name, estimator = chosen(settings)
    fit = maximum_likelihood.fit_windows([window], settings)
    if name == maximum_likelihood.NAME and fit is not None:
        return maximum_likelihood.finish(fit), fit
    return estimator([window], settings), fit


def _complete(estimate: Estimate, fit: Fit | None) -> Estimate:
    """Return the estimate with the fit's own value where a slow voltage leaves R or L open: a simulation needs all."""
    if fit is None or not estimate.missing or untold(estimate, slow=fit.problem.slow):
        return estimate
    return replace(estimate, values=np.where(np.isnan(estimate.values), fit.theta[:6], estimate.values))


def _doubts(
    window: Window, estimate: Estimate, fit: Fit | None, fit_percent: float | None, settings: Identification
) -> list[Reason]:
    reasons = untold(estimate, slow=window.slow_voltage is not None)
    open_end = bool(estimate.missing) and not reasons and fit is not None and not fit.converged
    if open_end or estimate.result is Result.DIVERGED:
        reasons.append(Reason("SolverFailed", "the fit does not converge", "look at the window's signals"))
    reasons += unphysical(estimate)
    if fit is None:
        return reasons or [Reason("RankDeficient", "there is no fit to check", "record a whole rapid")]
    late = _late(window, fit)
    if late is not None and _electrically_late(window, settings):
        return [*reasons, late]
    if late is not None:  # what else is wrong moves the delay too: without it, it shows under its own name
        fit = maximum_likelihood.fit(fit.problem.motions, np.append(fit.theta[:6], 0.0), range(6))
    if np.isfinite(fit.residuals).all() and np.isfinite(fit.information).all():
        found = _structure(fit, window)
        if not any(reason.code == "SampleTiming" for reason in found):  # a late current seems to move a shaft at rest
            found += rest_faults(window, fit)
        reasons += found or ([late] if late is not None else list(timing_faults(window, fit)))
    elif late is not None:
        reasons.append(late)
    least = expected_fit_percent(window, fit)
    if not reasons and fit_percent is not None and not fit_percent >= least:
        text = (
            f"the model simulated from the measured voltage follows the speed by {fit_percent:.2f} %, not {least:.2f} %"
        )
        reasons.append(Reason("ValidationFailed", text, "the drive does what the model does not have"))
    return reasons


def expected_fit_percent(window: Window, fit: Fit) -> float:
    """Return the fit that a right model has at least, from the noise of speed and of the voltage that drives it."""
    if window.slow_voltage is not None:
        return LEAST_FIT_PERCENT  # the voltage's course within its samples is not known
    noise = fit.problem.motions[0].noise
    own = fit.problem.noises[0].voltage_v
    p = Parameters(*fit.theta[:6])
    step = discretise(p, fit.problem.motions[0].voltage_period_s)
    push = step.mean[:, 0] / p.L * min(own, EXCESS * noise.voltage_v)
    # the steady state of P = phi P phi' + push push'
    spread = np.linalg.solve(np.eye(4) - np.kron(step.phi, step.phi), np.outer(push, push).ravel()).reshape(2, 2)
    variance = EXCESS * (noise.speed_rad_s**2 + spread[1, 1]) + (SHAPE_SHARE * window.rapid_speed_rad_s) ** 2
    deviation = float(np.nanstd(window.speed_rad_s))
    return max(LEAST_FIT_PERCENT, 100.0 * (1.0 - float(np.sqrt(variance)) / max(deviation, 1e-300)))


def _electrically_late(window: Window, settings: Identification) -> bool:
    """Return whether [5] alone shows a delay of whole samples: no torque or friction can pass for that."""
    return window.voltage_v is None or coarse_delay(least_squares.align(window, settings), window.dt_s) != 0.0


def _late(window: Window, fit: Fit) -> Reason | None:
    delay = float(fit.theta[6])
    period = max(window.dt_s, fit.problem.motions[0].voltage_period_s)
    if abs(delay) <= period:
        return None
    text = (
        f"voltage is {1e3 * abs(delay):.2f} ms {'late' if delay > 0 else 'early'} against current and speed, "
        f"more than a sample of {1e3 * period:.3g} ms"
    )
    return Reason("SampleTiming", text, "take voltage, current and speed from one SYNC, or enter the sensor's delay")


def _structure(fit: Fit, window: Window) -> list[Reason]:
    """Return the named finding that explains most, else what has no name."""
    tried = findings(fit)
    if window.slow_voltage is not None:
        late = list(current_late(window, fit, max((f.statistic**2 for f in tried), default=0.0)))
        if late:
            return late
    found = [f for f in tried if f.matters]
    if found:
        return [found[0].reason()]
    return [*whiteness(fit), *excess_noise(fit, window)]


def simulated_fit_percent(window: Window, estimate: Estimate) -> float | None:
    """Return 100 (1 - |w - what| / |w - mean w|) of the speed simulated from voltage; None without a model.

    A delay of the voltage that the estimate found, and that is no more than a sample, is taken out first.
    """
    p = estimate.parameters()
    values = np.array(list(p.as_dict().values()))
    if not np.isfinite(values).all() or not (values[:4] > 0).all():
        return None
    p = replace(p, ft=max(p.ft, 0.0), Cd=max(p.Cd, 0.0))
    if window.slow_voltage is not None:
        return _slow_fit_percent(window, p, estimate.delay_s or 0.0)
    if window.voltage_v is None:
        return None
    known = np.isfinite(window.speed_rad_s)
    voltage = carried(window.voltage_v)
    if estimate.delay_s and abs(estimate.delay_s) <= window.dt_s:
        row = np.arange(voltage.size)
        voltage = np.interp(row + estimate.delay_s / window.dt_s, row, voltage)
    _, speed = simulate_plant(p, voltage, window.dt_s, window.voltage_sampling)
    return _explained_percent(window.speed_rad_s[known], speed[known])


def _slow_fit_percent(window: Window, parameters: Parameters, delay_s: float) -> float | None:
    """Simulate on the grid of the slow sensor itself, and compare with the measured speed at its instants."""
    slow = window.slow_voltage
    assert slow is not None
    begin = slow.begin_s - delay_s + slow.period_s * np.arange(slow.voltage_v.size)
    _, speed = simulate_plant(parameters, carried(slow.voltage_v), slow.period_s, window.voltage_sampling)
    measured = np.interp(begin, np.arange(window.n) * window.dt_s, carried(window.speed_rad_s))
    return _explained_percent(measured, speed)


def _explained_percent(measured: Float, speed: Float) -> float | None:
    spread = float(np.linalg.norm(measured - measured.mean())) if measured.size else 0.0
    if spread == 0.0 or not np.isfinite(speed).all():
        return None
    return 100.0 * (1.0 - float(np.linalg.norm(measured - speed)) / spread)
