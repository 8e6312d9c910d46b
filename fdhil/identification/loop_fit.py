"""Fits a drive's own loops by output error: the closed loop's answer to the demand against position and current.

The demand is the drive's own input and has no noise, so nothing is biased by a sensor's noise. Mechanics are held by
what the rapids' estimate says of them: the inertia and each window's dry friction may move by a little, so that what
they are off does not end in a regulator's gain. Levenberg and Marquardt's steps on the kernel; both signals weigh as
what is left of them, renewed between the rounds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.config import Axis
from fdhil.identification.covariance import SUMMED_LAGS
from fdhil.identification.loop_replay import Rapid, replay, with_regulators
from fdhil.records import Float, Parameters

DELAY = "current_delay_cycles"
ROUNDS = 4
STEPS = 12
CONVERGED = 1e-4  # of the squares' sum
INERTIA_DOUBT = 0.03  # one standard deviation, relative: a sensor's gain moves K and Jt alike
FRICTION_DOUBT = 0.3
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
    """Rapids with the mechanics of each, and the axis whose regulators are sought; ``names`` are the keys that move."""

    rapids: tuple[Rapid, ...]
    mechanics: tuple[Parameters, ...]
    axis: Axis
    names: tuple[str, ...]

    @property
    def k(self) -> int:
        """Number of keys that move; behind them the inertia and each window's dry friction."""
        return len(self.names)

    def start(self) -> Float:
        """Return the coordinates (k + 1 + windows,) of the axis as it is."""
        regulators = self.axis.regulators
        keys = [KEYS[name].coordinate(float(getattr(regulators, name))) for name in self.names]
        return np.array([*keys, *([0.0] * (1 + len(self.rapids)))])

    def doubt(self) -> Float:
        """Return the standard deviations before any data, of the same shape."""
        return np.array([*(KEYS[n].doubt for n in self.names), INERTIA_DOUBT, *([FRICTION_DOUBT] * len(self.rapids))])

    def bounds(self) -> tuple[Float, Float]:
        """Return the least and the largest coordinates."""
        more = 1 + len(self.rapids)
        low = [KEYS[n].low for n in self.names] + [-0.5] * more
        return np.array(low), np.array([KEYS[n].high for n in self.names] + [0.5] * more)

    def drive(self, coordinates: Float) -> tuple[Axis, float]:
        """Return the axis with the regulators of some coordinates, and the delay in cycles, which need not be whole."""
        values = {n: KEYS[n].value(float(c)) for n, c in zip(self.names, coordinates, strict=False)}
        delay = values.pop(DELAY, float(self.axis.regulators.current_delay_cycles))
        return with_regulators(self.axis, **values), delay

    def plant(self, window: int, coordinates: Float) -> Parameters:
        """Return the mechanics of a window at some coordinates."""
        own, inertia, friction = self.mechanics[window], coordinates[self.k], coordinates[self.k + 1 + window]
        return replace(own, Jt=own.Jt * (1.0 + float(inertia)), Cd=own.Cd * (1.0 + float(friction)))

    def answers(self, coordinates: Float) -> list[Float]:
        """Return position and current (2, n) of each window."""
        drive, delay = self.drive(coordinates)
        return [self._answer(j, drive, delay, coordinates) for j in range(len(self.rapids))]

    def _answer(self, window: int, drive: Axis, delay: float, coordinates: Float) -> Float:
        return replay(self.rapids[window], self.plant(window, coordinates), drive, delay)

    def slopes(self, coordinates: Float, answers: Sequence[Float]) -> list[Float]:
        """Return how each window's position and current change (2, n, k + 2): with keys, inertia, its own friction."""
        out = [np.empty((*answer.shape, self.k + 2)) for answer in answers]
        _, high = self.bounds()
        for c in range(self.k + 1):
            step = KEYS[self.names[c]].step if c < self.k else 2e-3
            moved = coordinates.copy()
            step = -step if moved[c] + step > high[c] else step
            moved[c] += step
            for slope, one, answer in zip(out, self.answers(moved), answers, strict=True):
                slope[..., c] = (one - answer) / step
        moved = coordinates.copy()
        moved[self.k + 1 :] += 5e-3
        for slope, one, answer in zip(out, self.answers(moved), answers, strict=True):
            slope[..., -1] = (one - answer) / 5e-3
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
        pairs = zip(self.problem.names, self.coordinates, strict=False)
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
    """Return information (q, q), score (q,), and the score's covariance (q, q) of residuals that hang together.

    The last is Newey and West's (1987), a window at a time: what the model does not have is no white noise.
    """
    problem = made.problem
    size = problem.k + 1 + len(problem.rapids)
    information, score, meat = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
    pairs = zip(problem.rapids, made.left, strict=True)
    answers = [np.stack((rapid.position_mm, rapid.current_a)) - left for rapid, left in pairs]
    for j, slope in enumerate(problem.slopes(made.coordinates, answers)):
        known = problem.rapids[j].known
        columns = np.array([*range(problem.k + 1), problem.k + 1 + j])
        phi = slope[:, known] / made.scale[:, None, None]
        rest = made.left[j][:, known] / made.scale[:, None]
        rows = np.einsum("cnq,cn->nq", phi, rest)
        information[np.ix_(columns, columns)] += np.einsum("cnp,cnq->pq", phi, phi)
        score[columns] += rows.sum(axis=0)
        meat[np.ix_(columns, columns)] += _hanging(rows)
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
    k = made.problem.k
    wider = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(inverse), 1.0))
    floor = np.diag([(SYSTEMATIC if KEYS[name].scale == 0.0 else 0.0) ** 2 for name in made.problem.names])
    return np.asarray((inverse * np.outer(wider, wider))[:k, :k] + floor)
