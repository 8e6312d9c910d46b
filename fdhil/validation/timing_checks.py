"""Checks the delays of voltage and current by the fitted window's innovations.

A delay is estimated from its effect on the smooth part of a signal: where rows are fine, differences between
neighbouring rows hold more noise than signal, which hides a delay of several of them. Resistance and inductance imitate
most of a late voltage, and not in proportion to the delay, so that its size is searched for with the others fitted
again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from fdhil.identification import LikelihoodFit, exclude_delay, run_gauss_newton, set_delay
from fdhil.identification import fit_parameters_and_noise as refit
from fdhil.records import Reason
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.signal_delays import LARGEST, SignalDelay, build_delay_reason, estimate_delays
from fdhil.validation.window_fit import WindowFit

DOUBTFUL = 0.5  # samples: a delay that may be larger is searched for
SEARCH_DEVIATIONS = 2.5  # standard deviations
STRIDE = 1.0  # samples: other parameters fitted to no delay may hide most of a delay of several
SEARCH = 6  # fits: each removes most of the residual
REACH = 16.0  # samples: longer ones show in whole samples, see identification.delay
FOUND = 0.1  # samples
LATE = (1.5, 2.0, 2.5, 3.0)  # delays in samples that are compared with a winding shorter than a sample


def check_fitted_delay(fitted: WindowFit) -> Iterator[Reason]:
    """Yield a reason if the fit itself needs a delay of more than a sample."""
    late_s = fitted.voltage_delay_s
    if late_s:
        period_s = max(fitted.window.dt_s, fitted.required_fit.problem.motions[0].voltage_period_s)
        yield build_delay_reason("voltage", "current and speed", late_s, period_s)


def check_signal_delays(fitted: WindowFit) -> Iterator[Reason]:
    """Yield the signal that is late or early by more than a sample, with the figure."""
    window, fit = fitted.window, fitted.aligned_fit
    if fit.problem.motions[0].slow is not None:
        return  # there the delay is one of the parameters
    voltage, current = fitted.delays
    if current.is_significant and abs(current.samples) * voltage.std > abs(voltage.samples) * current.std:
        yield build_delay_reason("current", "voltage and speed", current.samples * window.dt_s, window.dt_s)
        return
    if abs(voltage.samples) + SEARCH_DEVIATIONS * voltage.std > DOUBTFUL:
        samples = search_voltage_delay(fit, voltage)
        if samples is not None and abs(samples) > LARGEST:
            yield build_delay_reason("voltage", "current and speed", samples * window.dt_s, window.dt_s)
            return
    yield from _check_short_winding(fit)


def _check_short_winding(fit: LikelihoodFit) -> Iterator[Reason]:
    """Yield a reason if a short winding may as well be a late voltage: both make the current follow early.

    If the time constant found is less than a sample, the window is refused unless it is significantly likelier than
    with a longer winding and a late voltage.
    """
    motion, theta = fit.problem.motions[0], fit.theta
    if theta[1] > theta[0] * motion.dt_s:
        return
    least = float(fit.residuals @ fit.residuals) * (1.0 + BUDGET["timing"].deviations ** 2 / fit.residuals.size)
    for samples in LATE:
        start = set_delay(theta, samples * motion.dt_s)
        theta, residuals, _, _ = run_gauss_newton(fit.problem, start, exclude_delay(fit.free))
        if float(residuals @ residuals) < least:
            short_ms, long_ms = (1e3 * t[1] / t[0] for t in (fit.theta, theta))
            text = (
                f"a winding of {short_ms:.2g} ms, less than a sample, is no likelier than one of {long_ms:.2g} ms "
                f"and a voltage {1e3 * samples * motion.dt_s:.2g} ms late"
            )
            yield Reason("SampleTiming", text, "take voltage and current from one SYNC, or sample faster")
            return


def search_voltage_delay(fit: LikelihoodFit, first: SignalDelay) -> float | None:
    """Return the delay of the voltage in samples beyond which, all else fitted to it, the innovations show no more.

    ``first`` is their first estimate; where it shows no direction, the voltage is assumed late, as sensors are. None
    unless the delay makes the window significantly likelier: regulators shift the innovations within a sample too, but
    that does not make the window likelier.
    """
    motion = fit.problem.motions[0]
    begun, last = float(fit.theta[6]) / motion.dt_s, fit

    def compute_residual_delay(delay: float) -> float:
        nonlocal last
        last = refit([motion], set_delay(last.theta, delay * motion.dt_s), exclude_delay(last.free))
        if not (np.isfinite(last.residuals).all() and np.isfinite(last.information).all()):
            return float("nan")
        return estimate_delays(last)[0].samples - delay

    rest = first.samples - begun
    stride = max(2.0 * abs(rest), STRIDE)  # a residual delay is underestimated
    found = _find_root(
        compute_residual_delay, begun, rest, -stride if rest < -SEARCH_DEVIATIONS * first.std else stride
    )
    return (
        found
        if found is not None
        and _compute_fit_deviance(fit) - _compute_fit_deviance(last) > BUDGET["timing"].deviations ** 2
        else None
    )


def _compute_fit_deviance(fit: LikelihoodFit) -> float:
    """Return minus twice the log likelihood, without its constant."""
    return float(fit.residuals @ fit.residuals) + fit.problem.filters[0].logdet


def _find_root(left: Callable[[float], float], begun: float, rest: float, stride: float) -> float | None:
    """Return the zero of ``left``, by secants within the bracket once there is one; None without a finite value.

    ``rest`` is the value at ``begun``; the first step is ``stride``.
    """
    known = [(begun, rest)]
    here = begun + stride
    for _ in range(SEARCH):
        here = float(np.clip(here, -REACH, REACH))
        value = left(here)
        if not np.isfinite(value):
            return None
        before, was = known[-1]
        known.append((here, value))
        if abs(value) < FOUND:
            break
        slope = (value - was) / (here - before) if here != before else 0.0
        above, below = [x for x, y in known if y > 0], [x for x, y in known if y <= 0]
        following = here - value / slope if slope < 0 else here + 2.0 * value
        if above and below:
            low, high = max(above), min(below)
            following = following if low < following < high else (low + high) / 2
        here = following
    return known[-1][0] + known[-1][1]
