"""Estimates the delays of voltage and current from the innovations of a fitted window's smooth part."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fdhil.identification import (
    CURRENT,
    VOLTAGE,
    LikelihoodFit,
    compute_motor_voltage_v,
    compute_moving_mean,
    compute_signal_response,
    invert_symmetric,
)
from fdhil.records import Float, Reason
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.score_tests import Finding, compute_expected_autocorrelation, compute_voltage_uncertainty

SMOOTHING_S = 0.010  # short enough for the jerk-limited course of a rapid
LARGEST = 1.0  # samples: a recorder may assign a value to the SYNC before or after it
LEAST = 0.1  # samples: the effect of regulators within one stays below
ADVICE = "take voltage, current and speed from one SYNC, or enter the sensor's delay"
LATE = " late"  # ends the names of these findings


@dataclass(frozen=True, slots=True)
class SignalDelay:
    """The delay of a window's voltage or current in samples (early: negative), and its standard deviation."""

    samples: float
    std: float
    own: float = 0.0  # samples beyond the delay of the fit
    direction: Float = field(default_factory=lambda: np.zeros(0))

    @property
    def is_significant(self) -> bool:
        """Return whether it is significant and more than a sample."""
        return abs(self.samples) > max(LARGEST, BUDGET["timing"].deviations * self.std)


def build_delay_reason(name: str, others: str, late_s: float, period_s: float) -> Reason:
    """Return the reason for a signal that is late (early: negative) against others by more than a sample."""
    delay = f"{1e3 * abs(late_s):.3g} ms {'late' if late_s > 0 else 'early'}"
    text = f"{name} is {delay} against {others}, more than a sample of {1e3 * period_s:.3g} ms"
    return Reason("SampleTiming", text, ADVICE)


def build_delay_findings(shown: tuple[SignalDelay, SignalDelay]) -> list[Finding]:
    """Return the delays of voltage and current that exceed what regulators cause within a sample, as findings."""
    return [
        Finding("SampleTiming", name + " is {:+.2g} samples late", ADVICE, LEAST, shift.own / shift.std, -shift.own,
                shift.direction, name=name + LATE)
        for name, shift in zip(("voltage", "current"), shown, strict=True)
        if abs(shift.own) > LEAST and np.isfinite(shift.std)
    ]  # fmt: skip


def estimate_delays(fit: LikelihoodFit) -> tuple[SignalDelay, SignalDelay]:
    """Return the delay of voltage and of current that the innovations show, each as if it were the only one."""
    motion, gains = fit.problem.motions[0], fit.problem.filters[0]
    width = 2 * round(SMOOTHING_S / 2 / motion.dt_s) + 1
    found = []
    jacobian = fit.jacobian_without_delay
    inverse, e = invert_symmetric(jacobian.T @ jacobian)[0], fit.residuals
    coloured = 1.0 + 2.0 * max(0.0, float(compute_expected_autocorrelation(fit)[0]))
    whole = np.column_stack([e, compute_voltage_uncertainty(fit)])
    whole = whole - jacobian @ (inverse @ (jacobian.T @ whole))
    for kind, values in ((VOLTAGE, compute_motor_voltage_v(motion, fit.theta)), (CURRENT, motion.current)):
        slope = np.gradient(compute_moving_mean(values, width))
        rise = [np.zeros(motion.n)] if kind == VOLTAGE else None
        answer = compute_signal_response(motion, fit.theta, gains, kind, [slope], rise)[:, 0]
        rest = answer - jacobian @ (inverse @ (jacobian.T @ answer))
        power = float(rest @ rest)
        if not power > 0.0:
            return SignalDelay(0.0, np.inf), SignalDelay(0.0, np.inf)
        score, *unsure = (rest @ whole) / power
        std = float(np.linalg.norm([*unsure, np.sqrt(coloured / power)]))
        found.append(SignalDelay(-float(score), std, -float(score), answer))
    voltage, current = found
    return replace(voltage, samples=voltage.samples + float(fit.theta[6]) / motion.dt_s), current
