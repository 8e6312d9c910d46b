"""Fits a drive's own loops by output error: the closed loop's answer to the demand against position and current.

The demand is the drive's own input and has no noise, so nothing is biased by a sensor's noise; what the mechanics do
not explain is a known load. Levenberg and Marquardt's steps on the kernel; both signals weigh as what is left of them,
renewed between the rounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.covariance import SUMMED_LAGS
from fdhil.identification.loop_replay import Rapid, replay, with_regulators
from fdhil.records import Float

DELAY = "current_delay_cycles"
ROUNDS = 4
STEPS = 12
CONVERGED = 1e-4  # of the squares' sum
SYSTEMATIC = 0.005  # of a gain: what rounding of the demand and a start that is not quite at rest do to all rapids
LEAST_POSITION_MM, LEAST_CURRENT_A = 1e-5, 1e-4


@dataclass(frozen=True, slots=True)
class Key:
    """A key of the regulators as the fit moves it: by ``scale``, or by its logarithm (0), between ``low`` and ``high``.

    ``doubt`` is how far off it may be to begin with, one standard deviation in that coordinate: it holds what the data
    cannot tell. ``step`` is what its derivative is taken over, ``usual`` where the search for an option begins.
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
    """Rapids, and the axis whose regulators are sought: ``names`` are the keys that move, k of them."""

    rapids: tuple[Rapid, ...]
    axis: Axis
    names: tuple[str, ...]

    def start(self) -> Float:
        """Return the coordinates (k,) of the axis as it is."""
        regulators = self.axis.regulators
        return np.array([KEYS[name].coordinate(float(getattr(regulators, name))) for name in self.names])

    def doubt(self) -> Float:
        """Return the standard deviations (k,) before any data."""
        return np.array([KEYS[name].doubt for name in self.names])

    def bounds(self) -> tuple[Float, Float]:
        """Return the least and the largest coordinates, (k,)."""
        return np.array([KEYS[n].low for n in self.names]), np.array([KEYS[n].high for n in self.names])

    def drive(self, coordinates: Float) -> tuple[Axis, float]:
        """Return the axis with the regulators of some coordinates, and the delay in cycles, which need not be whole."""
        values = {n: KEYS[n].value(float(c)) for n, c in zip(self.names, coordinates, strict=True)}
        delay = values.pop(DELAY, float(self.axis.regulators.current_delay_cycles))
        return with_regulators(self.axis, **values), delay

    def answers(self, coordinates: Float) -> list[Float]:
        """Return position and current (2, n) of each rapid."""
        drive, delay = self.drive(coordinates)
        return [replay(rapid, drive, delay) for rapid in self.rapids]

    def slopes(self, coordinates: Float, answers: Sequence[Float]) -> list[Float]:
        """Return how each rapid's position and current change with the keys, (2, n, k)."""
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
    """The bottom that was found: coordinates, what is left (2, n) of each window, in mm and A, and its scale (2,)."""

    problem: Problem
    coordinates: Float
    left: tuple[Float, ...]
    scale: Float

    @property
    def unexplained_um(self) -> float:
        """RMS of what is left of the position."""
        return float(spread_of(self.problem, self.left)[0]) * 1e3

    @property
    def deviance(self) -> float:
        """Minus twice the logarithm of the likelihood for each row, but for what all fits of the rapids share."""
        return float(2.0 * np.log(scale_of(self.problem, self.left)).sum())

    @property
    def values(self) -> dict[str, float]:
        """The keys that moved, in their units."""
        pairs = zip(self.problem.names, self.coordinates, strict=True)
        return {name: KEYS[name].value(float(c)) for name, c in pairs}

    def axis(self) -> Axis:
        """Return the axis with the regulators found; a delay is whole only where it was not sought."""
        return self.problem.drive(self.coordinates)[0]

    def squares(self, scale: Float) -> float:
        """Return the sum of squares at some scale."""
        pairs = zip(self.left, self.problem.rapids, strict=True)
        return float(sum((((r / scale[:, None]) ** 2).sum(axis=0)[one.known]).sum() for r, one in pairs))


def left_of(problem: Problem, coordinates: Float) -> tuple[tuple[Float, ...], list[Float]]:
    """Return what the closed loop leaves of each window, and its answers, both (2, n)."""
    answers = problem.answers(coordinates)
    measured = [np.stack((one.position_mm, one.current_a)) for one in problem.rapids]
    return tuple(m - a for m, a in zip(measured, answers, strict=True)), answers


def spread_of(problem: Problem, left: Sequence[Float]) -> Float:
    """Return the RMS (2,) of what is left, in mm and A."""
    whole = np.concatenate([r[:, one.known] for r, one in zip(left, problem.rapids, strict=True)], axis=1)
    return np.asarray(np.sqrt((whole**2).mean(axis=1)))


def scale_of(problem: Problem, left: Sequence[Float]) -> Float:
    """Return the scale (2,) at which what is left is weighed: its RMS, as far as that is not rounding."""
    return np.maximum(spread_of(problem, left), (LEAST_POSITION_MM, LEAST_CURRENT_A))


def fit(problem: Problem, start: Float | None = None, rounds: int = ROUNDS) -> Fit:
    """Return the regulators that explain position and current best, from the axis as it is or from ``start``."""
    at = problem.start() if start is None else start
    prior = at.copy()
    left, _ = left_of(problem, at)
    made = Fit(problem, at, left, scale_of(problem, left))
    for _ in range(rounds):
        before = made
        made = _descend(made, prior)
        settled = abs(made.unexplained_um - before.unexplained_um) < 1e-3 * before.unexplained_um
        made = replace(made, scale=scale_of(problem, made.left))
        if settled:
            break
    return made


def _descend(made: Fit, prior: Float) -> Fit:
    """Go down at one scale."""
    problem, weights = made.problem, 1.0 / made.problem.doubt() ** 2
    low, high = problem.bounds()
    damping = 1e-3

    def cost(of: Fit) -> float:
        return of.squares(made.scale) + float(weights @ (of.coordinates - prior) ** 2)

    now, current = cost(made), made
    for _ in range(STEPS):
        information, score, _ = normal(current)
        score = score - weights * (current.coordinates - prior)
        before = now
        for _ in range(8):
            matrix = information + np.diag(weights + damping * np.diag(information))
            step = _free_step(matrix, score, current.coordinates, low, high)
            at = np.clip(current.coordinates + step, low, high)
            trial = replace(current, coordinates=at, left=left_of(problem, at)[0])
            value = cost(trial)
            if np.isfinite(value) and value < now:
                now, current, damping = value, trial, max(damping / 10, 1e-9)
                break
            damping *= 8
        if before - now < CONVERGED * before:
            break
    return current


def _free_step(matrix: Float, score: Float, at: Float, low: Float, high: Float) -> Float:
    """Return the step of those coordinates that no bound holds."""
    held = (at <= low) & (score < 0) | (at >= high) & (score > 0)
    free = np.flatnonzero(~held)
    step = np.zeros_like(at)
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], score[free])
    return step


def normal(made: Fit) -> tuple[Float, Float, Float]:
    """Return information (k, k), score (k,), and the score's covariance (k, k) of residuals that hang together.

    The last is Newey and West's (1987), a window at a time: what the model does not have is no white noise.
    """
    problem, k = made.problem, len(made.problem.names)
    information, score, meat = np.zeros((k, k)), np.zeros(k), np.zeros((k, k))
    pairs = zip(problem.rapids, made.left, strict=True)
    answers = [np.stack((rapid.position_mm, rapid.current_a)) - left for rapid, left in pairs]
    for j, slope in enumerate(problem.slopes(made.coordinates, answers)):
        known = problem.rapids[j].known
        phi = slope[:, known] / made.scale[:, None, None]
        rest = made.left[j][:, known] / made.scale[:, None]
        rows = np.einsum("cnk,cn->nk", phi, rest)
        information += np.einsum("cnj,cnk->jk", phi, phi)
        score += rows.sum(axis=0)
        meat += _hanging(rows)
    return information, score, meat


def _hanging(rows: Float) -> Float:
    meat: Float = rows.T @ rows
    for lag in range(1, min(SUMMED_LAGS, len(rows) // 4) + 1):
        shifted = rows[lag:].T @ rows[:-lag]
        meat = meat + (1.0 - lag / (SUMMED_LAGS + 1)) * (shifted + shifted.T)
    return meat


def covariance_of(made: Fit) -> Float:
    """Return the covariance (k, k) of the keys' coordinates: the larger of the information's and the sandwich's."""
    information, _, meat = normal(made)
    inverse = np.linalg.inv(information + np.diag(1.0 / made.problem.doubt() ** 2))
    sandwich = inverse @ meat @ inverse
    wider = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    floor = np.diag([(SYSTEMATIC if KEYS[name].scale == 0.0 else 0.0) ** 2 for name in made.problem.names])
    return np.asarray((inverse * np.outer(wider, wider)) + floor)
