"""Does the model have the drive's structure? Score tests on the innovations of the fitted model.

Each alternative (a load torque for a while, a sensor gain that steps, friction that rises at low speed, an offset, a
delay) moves the innovations in its own direction. What of that direction the six parameters cannot imitate is compared
with the innovations: a statistic in standard deviations, and the alternative's amplitude in its own unit. Only what is
both beyond chance and large enough to matter refuses a window. Whiteness over lags catches what has no name.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fdhil.identification.estimators.maximum_likelihood import Fit, Problem
from fdhil.identification.innovations import innovations
from fdhil.identification.motion import Motion
from fdhil.records import Float, Reason

BEYOND_CHANCE = 5.5  # standard deviations: about 4e-8 a test, some hundred tests a window
EDGES = 24  # instants at which a load may begin or end, or a gain may step
LEAST_TORQUE = 0.01  # of the peak torque
LEAST_GAIN = 0.005
LEAST_OFFSET = 0.004  # of the signal's peak
LAGS = 25
WHITENESS_BEYOND_CHANCE = 5.0
PRACTICAL_CORRELATION = 0.15  # [LAN 93]: smaller correlations do no harm
NOISE_RATIO = 1.6
STRIBECK_SPEEDS = (0.01, 0.03, 0.06, 0.12)  # of the rapid speed


@dataclass(frozen=True, slots=True)
class Alternative:
    """One thing that the model does not have: its class, how it reads, and the least amplitude that matters."""

    code: str
    text: str
    least: float
    direction: Float
    advice: str


@dataclass(frozen=True, slots=True)
class Finding:
    """An alternative's statistic (standard deviations) and amplitude."""

    alternative: Alternative
    statistic: float
    amplitude: float

    @property
    def matters(self) -> bool:
        """Return whether the finding is beyond chance and large enough to matter."""
        return abs(self.statistic) > BEYOND_CHANCE and abs(self.amplitude) > self.alternative.least

    def reason(self) -> Reason:
        """Return the finding as a reason."""
        a = self.alternative
        return Reason(
            a.code, f"{a.text.format(self.amplitude)} ({abs(self.statistic):.0f} standard deviations)", a.advice
        )


def findings(fit: Fit) -> list[Finding]:
    """Return what the fit of one window shows beyond the model, the most significant first."""
    motion, problem = fit.problem.motions[0], fit.problem
    basis = np.linalg.qr(fit.jacobian)[0]
    found = []
    for alternative in alternatives(motion, problem, fit.theta, fit.residuals):
        d = alternative.direction - basis @ (basis.T @ alternative.direction)
        weight = float(d @ d)
        if weight > 1e-12:
            score = float(d @ fit.residuals)
            found.append(Finding(alternative, score / weight**0.5, score / weight))
    found.sort(key=lambda f: -abs(f.statistic))
    return found


def alternatives(motion: Motion, problem: Problem, theta: Float, base: Float) -> Iterator[Alternative]:
    """Yield every alternative with its direction (m,): minus the change of the innovations per unit of amplitude."""
    rows = np.flatnonzero(np.abs(motion.mode) == 1)
    if rows.size < 2 * EDGES:
        return
    edges = np.unique(np.linspace(rows[0], rows[-1] + 1, EDGES + 1).astype(int))
    yield from _loads(motion, problem, theta, base, edges)
    yield from _gain_steps(motion, problem, theta, base, edges[2:-2])
    yield from _offsets(motion, problem, theta, base)
    yield from _low_speed_friction(motion, problem, theta, base)


def _answer(problem: Problem, motion: Motion, theta: Float, base: Float, load: Float | None = None) -> Float:
    moved = innovations(motion, theta, problem.filters[0], theta[6], load).ravel()
    answer: Float = base - moved
    return answer


def _loads(motion: Motion, problem: Problem, theta: Float, base: Float, edges: Float) -> Iterator[Alternative]:
    peak = abs(theta[2]) * float(np.abs(motion.current).max())
    unit = 0.01 * peak
    steps = []
    for edge in edges[:-1]:
        load = np.zeros(motion.n)
        load[int(edge) :] = unit
        steps.append(_answer(problem, motion, theta, base, load) / unit)
    steps.append(np.zeros_like(base))
    for a in range(len(edges) - 1):
        for b in range(a + 1, len(edges)):
            t0, t1 = edges[a] * motion.dt_s, edges[b] * motion.dt_s
            yield Alternative(
                "LoadDetected",
                f"a torque of {{:+.3g}} N.m that is no friction acts from {t0:.3f} to {t1:.3f} s of the window",
                LEAST_TORQUE * peak,
                steps[a] - steps[b],
                "identify from moves without cutting, clamping or collision",
            )


def _gain_steps(motion: Motion, problem: Problem, theta: Float, base: Float, edges: Float) -> Iterator[Alternative]:
    for name in ("voltage", "current", "speed"):
        for edge in edges:
            changed = np.zeros(motion.n)
            changed[int(edge) :] = 1e-3
            scaled = _scaled(motion, name, 1 + changed)
            yield Alternative(
                "CalibrationSuspect",
                f"the gain of {name} changes by {{:+.2%}} at {edge * motion.dt_s:.3f} s of the window",
                LEAST_GAIN,
                _answer(problem, scaled, theta, base) / 1e-3,
                f"check the {name} sensor and its wiring",
            )


def _scaled(motion: Motion, name: str, factor: Float) -> Motion:
    if name == "voltage":
        return replace(motion, voltage_mean=motion.voltage_mean * factor, voltage_rise=motion.voltage_rise * factor)
    if name == "current":
        return replace(motion, current=motion.current * factor)
    return replace(motion, speed=motion.speed * factor)


def _shifted(motion: Motion, name: str, step: float) -> Motion:
    if name == "voltage":
        return replace(motion, voltage_mean=motion.voltage_mean + step)
    if name == "current":
        return replace(motion, current=motion.current + step)
    return replace(motion, speed=motion.speed + step)


def _offsets(motion: Motion, problem: Problem, theta: Float, base: Float) -> Iterator[Alternative]:
    for name, unit in (("voltage", "V"), ("current", "A"), ("speed", "rad/s")):
        values: Float = getattr(motion, "voltage_mean" if name == "voltage" else name)
        peak = float(np.abs(values).max())
        step = 1e-3 * peak
        moved = _shifted(motion, name, step)
        yield Alternative(
            "CalibrationSuspect",
            f"{name} has an offset of {{:+.3g}} {unit}",
            LEAST_OFFSET * peak,
            _answer(problem, moved, theta, base) / step,
            f"set the zero of the {name} sensor at standstill",
        )


def _low_speed_friction(motion: Motion, problem: Problem, theta: Float, base: Float) -> Iterator[Alternative]:
    peak = abs(theta[2]) * float(np.abs(motion.current).max())
    top = float(np.abs(motion.speed).max())
    for share in STRIBECK_SPEEDS:
        fall = np.exp(-((motion.speed / (share * top)) ** 2))
        load = 0.01 * peak * fall * motion.mode * (np.abs(motion.mode) == 1)
        yield Alternative(
            "ValidationFailed",
            f"friction is {{:+.3g}} N.m higher below {share * top:.3g} rad/s than above (Stribeck)",
            LEAST_TORQUE * peak,
            _answer(problem, motion, theta, base, load) / (0.01 * peak),
            "lubricate the slide-way, or identify faster moves only",
        )


def whiteness(fit: Fit) -> Iterator[Reason]:
    """Yield a reason where an autocorrelation of the innovations is neither chance (over all lags) nor harmless."""
    motion = fit.problem.motions[0]
    rows = (np.abs(motion.mode) == 1) & motion.observed
    e = fit.residuals.reshape(-1, 2)[rows]
    if e.shape[0] < 4 * LAGS:
        return
    limit = max(WHITENESS_BEYOND_CHANCE / np.sqrt(e.shape[0]), PRACTICAL_CORRELATION)
    for k, name in enumerate(("current", "speed")):
        power = float(e[:, k] @ e[:, k])
        correlations = np.array([e[lag:, k] @ e[:-lag, k] for lag in range(1, LAGS + 1)]) / power
        worst = int(np.argmax(np.abs(correlations)))
        if abs(correlations[worst]) > limit:
            text = (
                f"the innovations of {name} correlate by {correlations[worst]:+.2f} over {worst + 1} samples, "
                f"limit {limit:.2f}"
            )
            yield Reason("ValidationFailed", text, "the drive does what the model does not have: look at the residuals")


def excess_noise(fit: Fit) -> Iterator[Reason]:
    """Yield a reason where the fit needs more noise than the signal's own short-term scatter shows."""
    motion, fitted = fit.problem.motions[0], fit.problem.noises[0]
    for name, unit, wanted, seen in (
        ("voltage", "V", fitted.voltage_v, motion.noise.voltage_v),
        ("current", "A", fitted.current_a, motion.noise.current_a),
        ("speed", "rad/s", fitted.speed_rad_s, motion.noise.speed_rad_s),
    ):
        if wanted > NOISE_RATIO * seen:
            text = f"the model explains {name} to {wanted:.3g} {unit} only, while its noise is {seen:.3g} {unit}"
            yield Reason("ValidationFailed", text, "the drive does what the model does not have: look at the residuals")
