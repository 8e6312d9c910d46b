"""Detects unmodelled effects of unknown kind: autocorrelated innovations, and more noise than any sensor has."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fdhil.identification import LikelihoodFit, estimate_aliasing_doubt, estimate_open_voltage_v, invert_symmetric
from fdhil.records import Float, Reason, Window
from fdhil.validation.false_alarm_budget import BUDGET
from fdhil.validation.score_tests import LAGS, compute_expected_autocorrelation

PRACTICAL_CORRELATION = 0.25  # smaller ones are caused by the voltage's course within a sample and are harmless
NOISE_RATIO = 1.6
LOOK = "the drive has an effect that the model lacks: inspect the residuals"
_FIELDS = {"voltage": "voltage_v", "current": "current_a", "speed": "speed_rad_s"}


def find_autocorrelation(fit: LikelihoodFit) -> Iterator[tuple[str, Reason]]:
    """Yield signal and reason if its innovations are autocorrelated beyond chance over all lags, and not by little."""
    motion = fit.problem.motions[0]
    rows = (np.abs(motion.mode) == 1) & motion.observed
    e = fit.residuals[: 2 * motion.n].reshape(-1, 2)[rows]
    if e.shape[0] < 4 * LAGS:
        return
    limit = max(BUDGET["whiteness"].deviations / np.sqrt(e.shape[0]), PRACTICAL_CORRELATION)
    for k, name in enumerate(("current", "speed")):
        if name == "current" and motion.slow is not None:
            continue  # a slow voltage does not predict the current from row to row
        power = float(e[:, k] @ e[:, k])
        correlations = np.array([e[lag:, k] @ e[:-lag, k] for lag in range(1, LAGS + 1)]) / power
        if name == "current":  # fitted noise levels may hide a part of the expected correlation
            expected = compute_expected_autocorrelation(fit)
            correlations = correlations - np.clip(correlations, np.minimum(expected, 0.0), np.maximum(expected, 0.0))
        worst = int(np.argmax(np.abs(correlations)))
        if abs(correlations[worst]) > limit:
            text = (
                f"the innovations of {name} correlate by {correlations[worst]:+.2f} over {worst + 1} samples, "
                f"limit {limit:.2f}"
            )
            yield name, Reason("ValidationFailed", text, LOOK)


def find_excess_noise(fit: LikelihoodFit, window: Window) -> Iterator[tuple[str, Reason]]:
    """Yield signal and reason if the fit needs more noise than the signal's own scatter from row to row.

    The effect of the voltage's course within its samples, which the parameters do not imitate, is no reason.
    """
    fitted = fit.problem.noises[0]
    course = fit.problem.compute_shape_effect(fit.theta)
    course = course - fit.jacobian @ (invert_symmetric(fit.information)[0] @ (fit.jacobian.T @ course))
    missed = np.sqrt(np.mean(course[: 2 * fit.problem.motions[0].n].reshape(-1, 2) ** 2, axis=0))
    for name, unit, wanted, values, shape in (
        ("voltage", "V", fitted.voltage_v, window.voltage_v, 0.0),
        ("current", "A", fitted.current_a, window.current_a, float(missed[0])),
        ("speed", "rad/s", fitted.speed_rad_s, window.speed_rad_s, float(missed[1])),
    ):
        seen = max(_estimate_scatter(values), getattr(fit.problem.motions[0].noise, _FIELDS[name]))
        if name == "voltage":
            seen = float(np.hypot(seen, _compute_aliased_voltage_v(fit, window)))
        seen = float(np.hypot(seen, shape * wanted))
        if name == "voltage" and fit.problem.has_slow_voltage:  # the undetermined part of a sample hides its noise
            motion, theta = fit.problem.motions[0], fit.theta
            open_v = estimate_open_voltage_v(motion, theta, fitted.to_array() ** 2)
            wanted, seen = float(np.hypot(wanted, open_v)), float(np.hypot(seen, open_v))
        if wanted > NOISE_RATIO * seen:
            text = f"the model explains {name} to {wanted:.3g} {unit} only, while it scatters by {seen:.3g} {unit}"
            yield name, Reason("ValidationFailed", text, LOOK)


def _compute_aliased_voltage_v(fit: LikelihoodFit, window: Window) -> float:
    """Return the voltage that instants may miss of the course between them: the same uncertainty that R and L carry."""
    motion = fit.problem.motions[0]
    doubt = estimate_aliasing_doubt(window.voltage_sampling, motion.voltage_period_s) * np.abs(fit.theta[:6])
    current = motion.current[np.isfinite(motion.current)]
    rate = np.gradient(current, motion.dt_s)
    missed = doubt[0] * np.sqrt(np.mean(current**2)), doubt[1] * np.sqrt(np.mean(rate**2))
    return float(np.hypot(*missed))


def _estimate_scatter(values: Float | None) -> float:
    """Return a signal's scatter from row to row: noise, resolution, and its course within a few rows."""
    third = np.diff(values, 3) if values is not None else np.zeros(0)
    third = third[np.isfinite(third)]
    return float(np.sqrt(np.mean(third * third) / 20.0)) if third.size else 0.0
