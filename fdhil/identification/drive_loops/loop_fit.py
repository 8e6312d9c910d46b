"""Fits a drive's loops by output error: the closed loop's response to the demand against position and current.

The demand is free of noise, so sensor noise causes no bias; what the mechanics do not explain is a known load. Both
signals are scaled by their residuals, renewed between rounds of Levenberg-Marquardt.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.drive_loops.loop_replay import Rapid, replace_regulators, replay_rapid
from fdhil.identification.robust_covariance import estimate_long_run_variance
from fdhil.records import Float

DELAY = "current_delay_cycles"
STEPS, TRIALS = 24, 8
CONVERGED, ENOUGH = 1e-4, 0.05  # of the sum of squares: a smaller gain ends the steps, or requires new slopes
ROUNDS, SETTLED = 4, 1e-3  # renewals of the scale, until the residual changes by less
SYSTEMATIC = 0.005  # of a gain: common effect of the demand's rounding and of a start not quite at standstill
LEAST_POSITION_MM, LEAST_CURRENT_A = 1e-5, 1e-4


@dataclass(frozen=True, slots=True)
class RegulatorKey:
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

    def convert_to_coordinate(self, value: float) -> float:
        """Return the coordinate of a value."""
        return math.log(value) if self.scale == 0.0 else value / self.scale

    def convert_to_value(self, coordinate: float) -> float:
        """Return the value at a coordinate."""
        return math.exp(coordinate) if self.scale == 0.0 else coordinate * self.scale


_GAIN = RegulatorKey(0.0, math.log(1e-3), math.log(1e6), 1.0, 2e-3)
KEYS: dict[str, RegulatorKey] = {
    "position_gain_per_s": _GAIN,
    "speed_feedforward": RegulatorKey(1.0, 0.0, 1.5, 0.5, 1e-3),
    "speed_kp": _GAIN,
    "speed_ki": _GAIN,
    "position_ki_per_s2": RegulatorKey(100.0, 0.0, 1e4, 10.0, 1e-2, 1.0),
    "torque_feedforward": RegulatorKey(1.0, 0.0, 1.5, 0.5, 2e-3, 0.5),
    "speed_filter_s": RegulatorKey(1e-3, 0.0, 100.0, 3.0, 1e-2, 1.0),
    "setpoint_filter_s": RegulatorKey(1e-3, 0.0, 100.0, 3.0, 1e-2, 1.0),
    DELAY: RegulatorKey(1.0, 0.0, 32.0, 16.0, 0.5, 4.0),
}


@dataclass(frozen=True, slots=True)
class LoopProblem:
    """Rapids, and the axis whose regulators are fitted: the k keys ``names`` vary."""

    rapids: tuple[Rapid, ...]
    axis: Axis
    names: tuple[str, ...]

    def read_coordinates(self) -> Float:
        """Return the coordinates (k,) of the axis' present regulators."""
        regulators = self.axis.regulators
        return np.array([KEYS[name].convert_to_coordinate(float(getattr(regulators, name))) for name in self.names])

    def list_prior_stds(self) -> Float:
        """Return the prior standard deviations (k,)."""
        return np.array([KEYS[name].doubt for name in self.names])

    def list_bounds(self) -> tuple[Float, Float]:
        """Return the lower and upper bounds of the coordinates, (k,)."""
        return np.array([KEYS[n].low for n in self.names]), np.array([KEYS[n].high for n in self.names])

    def build_drive(self, coordinates: Float) -> tuple[Axis, float]:
        """Return the axis with the regulators of some coordinates, and the delay in cycles, not necessarily whole."""
        values = {n: KEYS[n].convert_to_value(float(c)) for n, c in zip(self.names, coordinates, strict=True)}
        delay = values.pop(DELAY, float(self.axis.regulators.current_delay_cycles))
        return replace_regulators(self.axis, **values), delay

    def replay_rapids(self, coordinates: Float) -> list[Float]:
        """Return position and current (2, n) of each rapid."""
        drive, delay = self.build_drive(coordinates)
        return [replay_rapid(rapid, drive, delay) for rapid in self.rapids]

    def compute_slopes(self, coordinates: Float, answers: Sequence[Float]) -> list[Float]:
        """Return the derivatives (2, n, k) of each rapid's position and current by the keys."""
        out = [np.empty((*answer.shape, len(self.names))) for answer in answers]
        _, high = self.list_bounds()
        for c, name in enumerate(self.names):
            step = KEYS[name].step if coordinates[c] + KEYS[name].step <= high[c] else -KEYS[name].step
            moved = coordinates.copy()
            moved[c] += step
            for slope, one, answer in zip(out, self.replay_rapids(moved), answers, strict=True):
                slope[..., c] = (one - answer) / step
        return out


@dataclass(frozen=True, slots=True)
class LoopFit:
    """The minimum: coordinates, ``residuals`` (2, n) of each rapid in mm and A, and their scale (2,)."""

    problem: LoopProblem
    coordinates: Float
    residuals: tuple[Float, ...]
    scale: Float

    @property
    def unexplained_um(self) -> float:
        """RMS residual of the position."""
        return float(compute_rms(self.problem, self.residuals)[0]) * 1e3

    @property
    def deviance(self) -> float:
        """Minus twice the log likelihood per sample, without the constant that all fits of the rapids share."""
        scale, spread = compute_scale(self.problem, self.residuals), compute_rms(self.problem, self.residuals)
        return float((2.0 * np.log(scale) + (spread / scale) ** 2).sum())

    @property
    def values(self) -> dict[str, float]:
        """The fitted keys, in their units."""
        pairs = zip(self.problem.names, self.coordinates, strict=True)
        return {name: KEYS[name].convert_to_value(float(c)) for name, c in pairs}

    def build_axis(self) -> Axis:
        """Return the axis with the fitted regulators; a delay is whole only where it was not fitted."""
        return self.problem.build_drive(self.coordinates)[0]

    def sum_squares(self, scale: Float) -> float:
        """Return the sum of squares at some scale."""
        pairs = zip(self.residuals, self.problem.rapids, strict=True)
        return float(sum(np.square((own / scale[:, None])[:, one.known]).sum() for own, one in pairs))

    def compute_responses(self) -> list[Float]:
        """Return the closed loop's position and current (2, n) for each rapid."""
        pairs = zip(self.problem.rapids, self.residuals, strict=True)
        return [np.stack((rapid.position_mm, rapid.current_a)) - own for rapid, own in pairs]


def compute_loop_residuals(problem: LoopProblem, coordinates: Float) -> tuple[tuple[Float, ...], list[Float]]:
    """Return residuals and responses of the closed loop, both (2, n) for each rapid."""
    answers = problem.replay_rapids(coordinates)
    measured = [np.stack((one.position_mm, one.current_a)) for one in problem.rapids]
    return tuple(m - a for m, a in zip(measured, answers, strict=True)), answers


def compute_rms(problem: LoopProblem, residuals: Sequence[Float]) -> Float:
    """Return the RMS (2,) of the residuals, in mm and A."""
    whole = np.concatenate([r[:, one.known] for r, one in zip(residuals, problem.rapids, strict=True)], axis=1)
    return np.asarray(np.sqrt((whole**2).mean(axis=1)))


def compute_scale(problem: LoopProblem, residuals: Sequence[Float]) -> Float:
    """Return the scale (2,) of the residuals: their RMS, but at least the rounding."""
    return np.maximum(compute_rms(problem, residuals), (LEAST_POSITION_MM, LEAST_CURRENT_A))


def fit_loops(problem: LoopProblem, start: Float | None = None) -> LoopFit:
    """Fit the regulators to position and current, from the axis' present ones or from ``start``."""
    at = problem.read_coordinates() if start is None else start
    residuals, _ = compute_loop_residuals(problem, at)
    fitted, prior = LoopFit(problem, at, residuals, compute_scale(problem, residuals)), at.copy()
    for _ in range(ROUNDS):
        before = fitted.unexplained_um
        fitted = _run_levenberg_marquardt(fitted, prior)
        fitted = replace(fitted, scale=compute_scale(problem, fitted.residuals))
        if abs(fitted.unexplained_um - before) < SETTLED * before:
            break
    return fitted


def _run_levenberg_marquardt(fitted: LoopFit, prior: Float) -> LoopFit:
    problem, damping, answers = fitted.problem, 1e-3, fitted.compute_responses()
    weights, (low, high) = 1.0 / problem.list_prior_stds() ** 2, problem.list_bounds()

    def compute_cost(of: LoopFit) -> float:
        return of.sum_squares(fitted.scale) + float(weights @ (of.coordinates - prior) ** 2)

    now, slopes, fresh = compute_cost(fitted), problem.compute_slopes(fitted.coordinates, answers), True
    for _ in range(STEPS):
        information, score = assemble_normal_equations(fitted, slopes)
        score = score - weights * (fitted.coordinates - prior)
        before = fitted, now, answers
        for _ in range(TRIALS if fresh else 1):
            matrix = information + np.diag(weights + damping * np.diag(information))
            step = _solve_bounded_step(matrix, score, fitted.coordinates, low, high)
            at = np.clip(fitted.coordinates + step, low, high)
            residuals, reached = compute_loop_residuals(problem, at)
            trial = replace(fitted, coordinates=at, residuals=residuals)
            value = compute_cost(trial)
            if np.isfinite(value) and value < now:
                now, fitted, answers, damping = value, trial, reached, max(damping / 10, 1e-9)
                break
            damping *= 8
        gained = before[1] - now
        if fresh and gained < CONVERGED * before[1]:
            break
        fresh = gained < ENOUGH * before[1]
        if fresh:
            slopes = problem.compute_slopes(fitted.coordinates, answers)
        else:
            slopes = _update_slopes_broyden(
                slopes, fitted.coordinates - before[0].coordinates, answers, before[2], information
            )
    return fitted


def _update_slopes_broyden(
    slopes: Sequence[Float], step: Float, after: Sequence[Float], before: Sequence[Float], metric: Float
) -> list[Float]:
    """Return slopes (2, n, k) updated by the effect of a ``step`` (Broyden 1965): new ones cost as much as all else."""
    share = np.diag(metric) * step
    share = share / max(float(share @ step), 1e-300)
    return [own + (a - b - own @ step)[..., None] * share for own, a, b in zip(slopes, after, before, strict=True)]


def _solve_bounded_step(matrix: Float, score: Float, at: Float, low: Float, high: Float) -> Float:
    held = (at <= low) & (score < 0) | (at >= high) & (score > 0)
    free = np.flatnonzero(~held)
    step = np.zeros_like(at)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], score[free])
    return step


def assemble_normal_equations(fitted: LoopFit, slopes: Sequence[Float]) -> tuple[Float, Float]:
    """Return information (k, k) and score (k,) of a fit with the ``slopes`` (2, n, k) of each rapid."""
    k = slopes[0].shape[2]
    information, score = np.zeros((k, k)), np.zeros(k)
    for phi, rest in _scale_residuals(fitted, slopes):
        flat = phi.reshape(-1, k)
        information += flat.T @ flat
        score += flat.T @ rest.ravel()
    return information, score


def _scale_residuals(fitted: LoopFit, slopes: Sequence[Float]) -> Iterator[tuple[Float, Float]]:
    """Yield scaled slopes (2, m, k) and residuals (2, m) of each rapid's complete samples."""
    for rapid, own, slope in zip(fitted.problem.rapids, fitted.residuals, slopes, strict=True):
        known = rapid.known
        yield slope[:, known] / fitted.scale[:, None, None], own[:, known] / fitted.scale[:, None]


def estimate_covariance(fitted: LoopFit) -> Float:
    """Return the covariance (k, k) of the coordinates: the larger of inverse information and sandwich."""
    slopes = fitted.problem.compute_slopes(fitted.coordinates, fitted.compute_responses())
    information, _ = assemble_normal_equations(fitted, slopes)
    # unmodelled dynamics are coloured (Newey and West 1987)
    meat = sum(
        estimate_long_run_variance(np.einsum("cnk,cn->nk", phi, rest)) for phi, rest in _scale_residuals(fitted, slopes)
    )
    inverse = np.linalg.inv(information + np.diag(1.0 / fitted.problem.list_prior_stds() ** 2))
    sandwich = inverse @ meat @ inverse
    wider = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    floor = np.diag([(SYSTEMATIC if KEYS[name].scale == 0.0 else 0.0) ** 2 for name in fitted.problem.names])
    return np.asarray((inverse * np.outer(wider, wider)) + floor)


def rank_extensions(fitted: LoopFit, options: Sequence[tuple[str, ...]]) -> list[LoopFit]:
    """Return the starts of fits with additional keys, the likeliest first.

    Each of the ``options`` is extrapolated linearly, from the end of the fit without it and from that fit's start,
    because a missing key distorts the others.
    """
    begun = fitted.problem.read_coordinates()
    residuals, _ = compute_loop_residuals(fitted.problem, begun)
    starts = (fitted, LoopFit(fitted.problem, begun, residuals, compute_scale(fitted.problem, residuals)))
    found = [one for start in starts for one in _predict_extensions(start, options)]
    return sorted((one for one in found if math.isfinite(one.deviance)), key=lambda one: one.deviance)


def _predict_extensions(start: LoopFit, options: Sequence[tuple[str, ...]]) -> Iterator[LoopFit]:
    slopes = start.problem.compute_slopes(start.coordinates, start.compute_responses())
    for option in options:
        wider = replace(start.problem, names=(*start.problem.names, *option))
        at = np.append(start.coordinates, [KEYS[name].usual for name in option])
        residuals, answers = compute_loop_residuals(wider, at)
        own = replace(wider, axis=start.build_axis(), names=option).compute_slopes(at[-len(option) :], answers)
        both = [np.concatenate(pair, axis=2) for pair in zip(slopes, own, strict=True)]
        information, score = assemble_normal_equations(
            LoopFit(wider, at, residuals, compute_scale(wider, residuals)), both
        )
        low, high = wider.list_bounds()
        at = np.clip(at + np.linalg.solve(information + np.diag(1.0 / wider.list_prior_stds() ** 2), score), low, high)
        if (at[-len(option) :] > 0.0).all():
            residuals, _ = compute_loop_residuals(wider, at)
            yield LoopFit(wider, at, residuals, compute_scale(wider, residuals))
