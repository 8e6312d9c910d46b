"""Fits a drive's loops by output error: the closed loop's response to the demand against position and current.

The demand is free of noise, so sensor noise causes no bias; what the mechanics do not explain is a known load. Both
signals are scaled by their residuals, renewed between rounds of Levenberg-Marquardt.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.covariance import summed
from fdhil.identification.loop_replay import Rapid, replay, with_regulators
from fdhil.records import Float

DELAY = "current_delay_cycles"
STEPS, TRIALS = 24, 8
CONVERGED, ENOUGH = 1e-4, 0.05  # of the sum of squares: a smaller gain ends the steps, or requires new slopes
ROUNDS, SETTLED = 4, 1e-3  # renewals of the scale, until the residual changes by less
SYSTEMATIC = 0.005  # of a gain: common effect of the demand's rounding and of a start not quite at standstill
LEAST_POSITION_MM, LEAST_CURRENT_A = 1e-5, 1e-4


@dataclass(frozen=True, slots=True)
class Key:
    """A regulator key in the fit: scaled by ``scale``, or logarithmic (0), between ``low`` and ``high``.

    ``doubt`` is the prior standard deviation in that coordinate; it holds what the data do not determine. ``step`` is
    the difference for its derivative, ``usual`` the start value of an option.
    """

    scale: float
    low: float
    high: float
    doubt: float
    step: float
    usual: float = 0.0

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value."""
        return math.log(value) if self.scale == 0.0 else value / self.scale

    def value(self, coordinate: float) -> float:
        """Return the value at a coordinate."""
        return math.exp(coordinate) if self.scale == 0.0 else coordinate * self.scale


_GAIN = Key(0.0, math.log(1e-3), math.log(1e6), 1.0, 2e-3)
KEYS: dict[str, Key] = {
    "position_gain_per_s": _GAIN,
    "speed_feedforward": Key(1.0, 0.0, 1.5, 0.5, 1e-3),
    "speed_kp": _GAIN,
    "speed_ki": _GAIN,
    "position_ki_per_s2": Key(100.0, 0.0, 1e4, 10.0, 1e-2, 1.0),
    "torque_feedforward": Key(1.0, 0.0, 1.5, 0.5, 2e-3, 0.5),
    "speed_filter_s": Key(1e-3, 0.0, 100.0, 3.0, 1e-2, 1.0),
    "setpoint_filter_s": Key(1e-3, 0.0, 100.0, 3.0, 1e-2, 1.0),
    DELAY: Key(1.0, 0.0, 32.0, 16.0, 0.5, 4.0),
}


@dataclass(frozen=True, slots=True)
class Problem:
    """Rapids, and the axis whose regulators are fitted: the k keys ``names`` vary."""

    rapids: tuple[Rapid, ...]
    axis: Axis
    names: tuple[str, ...]

    def start(self) -> Float:
        """Return the coordinates (k,) of the axis' present regulators."""
        regulators = self.axis.regulators
        return np.array([KEYS[name].coordinate(float(getattr(regulators, name))) for name in self.names])

    def doubt(self) -> Float:
        """Return the prior standard deviations (k,)."""
        return np.array([KEYS[name].doubt for name in self.names])

    def bounds(self) -> tuple[Float, Float]:
        """Return the lower and upper bounds of the coordinates, (k,)."""
        return np.array([KEYS[n].low for n in self.names]), np.array([KEYS[n].high for n in self.names])

    def drive(self, coordinates: Float) -> tuple[Axis, float]:
        """Return the axis with the regulators of some coordinates, and the delay in cycles, not necessarily whole."""
        values = {n: KEYS[n].value(float(c)) for n, c in zip(self.names, coordinates, strict=True)}
        delay = values.pop(DELAY, float(self.axis.regulators.current_delay_cycles))
        return with_regulators(self.axis, **values), delay

    def answers(self, coordinates: Float) -> list[Float]:
        """Return position and current (2, n) of each rapid."""
        drive, delay = self.drive(coordinates)
        return [replay(rapid, drive, delay) for rapid in self.rapids]

    def slopes(self, coordinates: Float, answers: Sequence[Float]) -> list[Float]:
        """Return the derivatives (2, n, k) of each rapid's position and current by the keys."""
        out = [np.empty((*answer.shape, len(self.names))) for answer in answers]
        _, high = self.bounds()
        for c, name in enumerate(self.names):
            step = KEYS[name].step if coordinates[c] + KEYS[name].step <= high[c] else -KEYS[name].step
            moved = coordinates.copy()
            moved[c] += step
            for slope, one, answer in zip(out, self.answers(moved), answers, strict=True):
                slope[..., c] = (one - answer) / step
        return out


@dataclass(frozen=True, slots=True)
class Fit:
    """The minimum: coordinates, ``residuals`` (2, n) of each rapid in mm and A, and their scale (2,)."""

    problem: Problem
    coordinates: Float
    residuals: tuple[Float, ...]
    scale: Float

    @property
    def unexplained_um(self) -> float:
        """RMS residual of the position."""
        return float(spread_of(self.problem, self.residuals)[0]) * 1e3

    @property
    def deviance(self) -> float:
        """Minus twice the log likelihood per sample, without the constant that all fits of the rapids share."""
        scale, spread = scale_of(self.problem, self.residuals), spread_of(self.problem, self.residuals)
        return float((2.0 * np.log(scale) + (spread / scale) ** 2).sum())

    @property
    def values(self) -> dict[str, float]:
        """The fitted keys, in their units."""
        pairs = zip(self.problem.names, self.coordinates, strict=True)
        return {name: KEYS[name].value(float(c)) for name, c in pairs}

    def axis(self) -> Axis:
        """Return the axis with the fitted regulators; a delay is whole only where it was not fitted."""
        return self.problem.drive(self.coordinates)[0]

    def squares(self, scale: Float) -> float:
        """Return the sum of squares at some scale."""
        pairs = zip(self.residuals, self.problem.rapids, strict=True)
        return float(sum(np.square((own / scale[:, None])[:, one.known]).sum() for own, one in pairs))

    def answers(self) -> list[Float]:
        """Return the closed loop's position and current (2, n) for each rapid."""
        pairs = zip(self.problem.rapids, self.residuals, strict=True)
        return [np.stack((rapid.position_mm, rapid.current_a)) - own for rapid, own in pairs]


def left_of(problem: Problem, coordinates: Float) -> tuple[tuple[Float, ...], list[Float]]:
    """Return residuals and responses of the closed loop, both (2, n) for each rapid."""
    answers = problem.answers(coordinates)
    measured = [np.stack((one.position_mm, one.current_a)) for one in problem.rapids]
    return tuple(m - a for m, a in zip(measured, answers, strict=True)), answers


def spread_of(problem: Problem, residuals: Sequence[Float]) -> Float:
    """Return the RMS (2,) of the residuals, in mm and A."""
    whole = np.concatenate([r[:, one.known] for r, one in zip(residuals, problem.rapids, strict=True)], axis=1)
    return np.asarray(np.sqrt((whole**2).mean(axis=1)))


def scale_of(problem: Problem, residuals: Sequence[Float]) -> Float:
    """Return the scale (2,) of the residuals: their RMS, but at least the rounding."""
    return np.maximum(spread_of(problem, residuals), (LEAST_POSITION_MM, LEAST_CURRENT_A))


def fit(problem: Problem, start: Float | None = None) -> Fit:
    """Fit the regulators to position and current, from the axis' present ones or from ``start``."""
    at = problem.start() if start is None else start
    residuals, _ = left_of(problem, at)
    fitted, prior = Fit(problem, at, residuals, scale_of(problem, residuals)), at.copy()
    for _ in range(ROUNDS):
        before = fitted.unexplained_um
        fitted = _descend(fitted, prior)
        fitted = replace(fitted, scale=scale_of(problem, fitted.residuals))
        if abs(fitted.unexplained_um - before) < SETTLED * before:
            break
    return fitted


def _descend(fitted: Fit, prior: Float) -> Fit:
    problem, damping, answers = fitted.problem, 1e-3, fitted.answers()
    weights, (low, high) = 1.0 / problem.doubt() ** 2, problem.bounds()

    def cost(of: Fit) -> float:
        return of.squares(fitted.scale) + float(weights @ (of.coordinates - prior) ** 2)

    now, slopes, fresh = cost(fitted), problem.slopes(fitted.coordinates, answers), True
    for _ in range(STEPS):
        information, score = normal(fitted, slopes)
        score = score - weights * (fitted.coordinates - prior)
        before = fitted, now, answers
        for _ in range(TRIALS if fresh else 1):
            matrix = information + np.diag(weights + damping * np.diag(information))
            step = _free_step(matrix, score, fitted.coordinates, low, high)
            at = np.clip(fitted.coordinates + step, low, high)
            residuals, reached = left_of(problem, at)
            trial = replace(fitted, coordinates=at, residuals=residuals)
            value = cost(trial)
            if np.isfinite(value) and value < now:
                now, fitted, answers, damping = value, trial, reached, max(damping / 10, 1e-9)
                break
            damping *= 8
        gained = before[1] - now
        if fresh and gained < CONVERGED * before[1]:
            break
        fresh = gained < ENOUGH * before[1]
        if fresh:
            slopes = problem.slopes(fitted.coordinates, answers)
        else:
            slopes = _turned(slopes, fitted.coordinates - before[0].coordinates, answers, before[2], information)
    return fitted


def _turned(
    slopes: Sequence[Float], step: Float, after: Sequence[Float], before: Sequence[Float], metric: Float
) -> list[Float]:
    """Return slopes (2, n, k) updated by the effect of a ``step`` (Broyden 1965): new ones cost as much as all else."""
    share = np.diag(metric) * step
    share = share / max(float(share @ step), 1e-300)
    return [own + (a - b - own @ step)[..., None] * share for own, a, b in zip(slopes, after, before, strict=True)]


def _free_step(matrix: Float, score: Float, at: Float, low: Float, high: Float) -> Float:
    held = (at <= low) & (score < 0) | (at >= high) & (score > 0)
    free = np.flatnonzero(~held)
    step = np.zeros_like(at)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], score[free])
    return step


def normal(fitted: Fit, slopes: Sequence[Float]) -> tuple[Float, Float]:
    """Return information (k, k) and score (k,) of a fit with the ``slopes`` (2, n, k) of each rapid."""
    k = slopes[0].shape[2]
    information, score = np.zeros((k, k)), np.zeros(k)
    for phi, rest in _weighed(fitted, slopes):
        flat = phi.reshape(-1, k)
        information += flat.T @ flat
        score += flat.T @ rest.ravel()
    return information, score


def _weighed(fitted: Fit, slopes: Sequence[Float]) -> Iterator[tuple[Float, Float]]:
    """Yield scaled slopes (2, m, k) and residuals (2, m) of each rapid's complete samples."""
    for rapid, own, slope in zip(fitted.problem.rapids, fitted.residuals, slopes, strict=True):
        known = rapid.known
        yield slope[:, known] / fitted.scale[:, None, None], own[:, known] / fitted.scale[:, None]


def covariance_of(fitted: Fit) -> Float:
    """Return the covariance (k, k) of the coordinates: the larger of inverse information and sandwich."""
    slopes = fitted.problem.slopes(fitted.coordinates, fitted.answers())
    information, _ = normal(fitted, slopes)
    # unmodelled dynamics are coloured (Newey and West 1987)
    meat = sum(summed(np.einsum("cnk,cn->nk", phi, rest)) for phi, rest in _weighed(fitted, slopes))
    inverse = np.linalg.inv(information + np.diag(1.0 / fitted.problem.doubt() ** 2))
    sandwich = inverse @ meat @ inverse
    wider = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    floor = np.diag([(SYSTEMATIC if KEYS[name].scale == 0.0 else 0.0) ** 2 for name in fitted.problem.names])
    return np.asarray((inverse * np.outer(wider, wider)) + floor)


def likeliest(fitted: Fit, options: Sequence[tuple[str, ...]]) -> list[Fit]:
    """Return the starts of fits with additional keys, the likeliest first.

    Each of the ``options`` is extrapolated linearly, from the end of the fit without it and from that fit's start,
    because a missing key distorts the others.
    """
    begun = fitted.problem.start()
    residuals, _ = left_of(fitted.problem, begun)
    starts = (fitted, Fit(fitted.problem, begun, residuals, scale_of(fitted.problem, residuals)))
    found = [one for start in starts for one in _ahead(start, options)]
    return sorted((one for one in found if math.isfinite(one.deviance)), key=lambda one: one.deviance)


def _ahead(start: Fit, options: Sequence[tuple[str, ...]]) -> Iterator[Fit]:
    slopes = start.problem.slopes(start.coordinates, start.answers())
    for option in options:
        wider = replace(start.problem, names=(*start.problem.names, *option))
        at = np.append(start.coordinates, [KEYS[name].usual for name in option])
        residuals, answers = left_of(wider, at)
        own = replace(wider, axis=start.axis(), names=option).slopes(at[-len(option) :], answers)
        both = [np.concatenate(pair, axis=2) for pair in zip(slopes, own, strict=True)]
        information, score = normal(Fit(wider, at, residuals, scale_of(wider, residuals)), both)
        low, high = wider.bounds()
        at = np.clip(at + np.linalg.solve(information + np.diag(1.0 / wider.doubt() ** 2), score), low, high)
        if (at[-len(option) :] > 0.0).all():
            residuals, _ = left_of(wider, at)
            yield Fit(wider, at, residuals, scale_of(wider, residuals))
