"""Estimates how much a drive's parameters vary from window to window, from the drive's own history.

R, ft and Cd follow a random walk with temperature; windows also scatter beyond their own covariance (Paule, Mandel
1982). The sizes on a grid are weighted by the restricted likelihood of the newest windows (Patterson, Thompson 1971)
and by a prior that favours no variation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.model import compile_kernel
from fdhil.records import PARAMETERS, Float

HISTORY_WINDOWS = 24  # windows: older ones say little about the present warming
FOR_BOTH_SLOPES = 3  # windows per direction from which on viscous friction may depend on it
# shares of a parameter's size; finer steps than a factor of two change no interval by a tenth
STEPS = np.array([0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064])
SCATTERS = np.array([0.0, 0.003, 0.01, 0.03])
SMALL_SCATTERS = np.array([0.0, 0.0005, 0.002, 0.008])
UNKNOWN = 100.0  # squared shares of a parameter's size: prior variance
SURELY = 6.9  # log likelihood ratio that two more sizes reach by chance once in a thousand
NO_SCATTER = 0.9  # prior probability of no scatter


@dataclass(frozen=True, slots=True)
class PoolMember:
    """Estimates of one window: ``values`` (k,) of ``names`` with their ``own`` covariance (k, k).

    ``shared`` (k, q) are systematic doubts common to all windows of the drive, one standard deviation a column.
    ``place`` is the number of the window, ``direction`` is 1 or -1.
    """

    names: tuple[str, ...]
    values: Float
    own: Float
    shared: Float
    place: int
    direction: int

    def select_parameters(self, names: Sequence[str]) -> tuple[Float, Float]:
        """Return values (p,) and own covariance (p, p) of the named parameters."""
        rows = [self.names.index(name) for name in names]
        return self.values[rows], self.own[rows][:, rows]


@dataclass(frozen=True, slots=True)
class BetweenWindowVariance:
    """Variances between windows, by name, in squared shares of the parameter's size in ``sizes``.

    ``walk`` is added for each window between two, ``scatter`` for each window by itself. ``surely`` is true where the
    variation is significant.
    """

    sizes: dict[str, float]
    walk: dict[str, float]
    scatter: dict[str, float]
    surely: bool


NO_BETWEEN_VARIANCE = BetweenWindowVariance({}, {}, {}, surely=False)
"""Windows that differ by their own chance alone."""


@dataclass(frozen=True, slots=True)
class ParameterGroup:
    """Parameters that vary together, and the grid of their walks and scatters.

    ``steady`` is the prior probability that they do not walk.
    """

    names: tuple[str, ...]
    steps: Float
    scatters: Float
    steady: float = 1.0

    def build_grid(self) -> tuple[Float, Float]:
        """Return (g, 2) shares of walk and scatter, and the logarithms (g,) of their prior probabilities."""
        pairs = np.array([(walk, scatter) for walk in self.steps for scatter in self.scatters])
        chances = np.outer(
            _compute_prior_chances(self.steps, self.steady), _compute_prior_chances(self.scatters, NO_SCATTER)
        )
        return pairs, np.log(chances.ravel())


def _compute_prior_chances(sizes: Float, none: float) -> Float:
    others = sizes.size - 1
    return np.array([none, *[(1.0 - none) / others] * others]) if others else np.ones(1)


_NONE = np.zeros(1)
PARAMETER_GROUPS = (
    ParameterGroup(("R",), STEPS, _NONE, 0.7),
    ParameterGroup(("L",), _NONE, SMALL_SCATTERS),
    ParameterGroup(("K",), _NONE, SMALL_SCATTERS),
    ParameterGroup(("Jt",), _NONE, SMALL_SCATTERS),
    ParameterGroup(("ft", "Cd"), STEPS, SCATTERS, 0.3),
)


def estimate_between_window_variance(members: Sequence[PoolMember]) -> BetweenWindowVariance:
    """Estimate how much the parameters vary between windows given in order; only the newest ``HISTORY`` count."""
    newest = members[-HISTORY_WINDOWS:]
    sizes: dict[str, float] = {}
    walk: dict[str, float] = {}
    scatter: dict[str, float] = {}
    surely = False
    for kind in PARAMETER_GROUPS:
        telling = [m for m in newest if set(kind.names) <= set(m.names)]
        if len(telling) < 2:
            continue
        likely, prior, pairs, typical = _evaluate_grid_likelihood(telling, kind)
        weights = np.exp(likely + prior - (likely + prior).max())
        found = weights @ pairs**2 / weights.sum()
        surely = surely or float(likely.max() - likely[0]) > SURELY
        for name, size in zip(kind.names, typical, strict=True):
            sizes[name], walk[name], scatter[name] = float(size), float(found[0]), float(found[1])
    for name in dict.fromkeys(name for m in newest for name in m.names if name not in PARAMETERS):
        sizes[name], scatter[name] = (
            1.0,
            _estimate_excess_variance([m.select_parameters([name]) for m in newest if name in m.names]),
        )
    return BetweenWindowVariance(sizes, walk, scatter, surely)


def _estimate_excess_variance(estimates: Sequence[tuple[Float, Float]]) -> float:
    """Return the variance of one term beyond its own (DerSimonian, Laird 1986).

    Where windows disagree on a ripple or a resonance, it must not distort the other parameters of the pool.
    """
    values = np.array([value[0] for value, _ in estimates])
    weights = 1.0 / np.maximum([own[0, 0] for _, own in estimates], np.finfo(np.float64).tiny)
    whole = float(weights.sum())
    apart = float(weights @ np.square(values - weights @ values / whole)) - (values.size - 1)
    spread = whole - float(weights @ weights) / whole
    return max(0.0, apart / spread) if spread > 0.0 else 0.0


def _evaluate_grid_likelihood(members: Sequence[PoolMember], kind: ParameterGroup) -> tuple[Float, Float, Float, Float]:
    estimates = [m.select_parameters(kind.names) for m in members]
    values = np.array([value for value, _ in estimates])
    typical = np.median(np.abs(values), axis=0)
    typical[typical == 0.0] = 1.0
    owns = np.array([own for _, own in estimates]) / np.outer(typical, typical)
    pairs, prior = kind.build_grid()
    places = np.array([m.place for m in members], dtype=np.float64)
    likely = _compute_grid_likelihoods(owns, _build_level_design(members, kind), values / typical, places, pairs)
    return likely, prior, pairs, typical


def _build_level_design(members: Sequence[PoolMember], kind: ParameterGroup) -> Float:
    """Return the design (n, p, k): each parameter's level, and the part of friction that depends on the direction.

    Before the load is identified, a difference of sign between directions must not count as scatter.
    """
    n, p = len(members), len(kind.names)
    columns = [np.tile(np.eye(p), (n, 1, 1))]
    side = np.array([m.direction for m in members], dtype=np.float64)
    fewest = min(np.count_nonzero(side > 0), np.count_nonzero(side < 0))
    for name, least in (("Cd", 1), ("ft", FOR_BOTH_SLOPES)):
        if name in kind.names and fewest >= least:
            column = np.zeros((n, p, 1))
            column[:, kind.names.index(name), 0] = side
            columns.append(column)
    return np.concatenate(columns, axis=2)


def _run_filter_bank(owns: Float, levels: Float, values: Float, places: Float, pairs: Float) -> Float:
    """Return the log-likelihood (g,) of each pair of walk and scatter by one Kalman filter over the windows each.

    ``owns`` (n, p, p) are the windows' covariances, ``levels`` (n, p, k) map the state (k,) to ``values`` (n, p); the
    first p states walk. The diffuse start makes the likelihood restricted. A window's values are decorrelated and
    processed one by one.
    """
    n, p, k = levels.shape
    likely, state, spread, lever = np.zeros(len(pairs)), np.zeros(k), np.zeros((k, k)), np.zeros(k)
    root, rows, reported = np.zeros((p, p)), np.zeros((p, k)), np.zeros(p)
    for g in range(len(pairs)):
        walk, scatter = pairs[g, 0] ** 2, pairs[g, 1] ** 2
        state[:], spread[:] = 0.0, 0.0
        for a in range(k):
            spread[a, a] = UNKNOWN
        for j in range(n):
            for q in range(p):
                spread[q, q] += walk * (places[j] - places[max(j - 1, 0)])
                # the next row of the covariance's Cholesky root, applied to the columns
                for a in range(q + 1):
                    left = owns[j, q, a] + (scatter if a == q else 0.0)
                    for c in range(a):
                        left -= root[q, c] * root[a, c]
                    root[q, a] = math.sqrt(left) if a == q else left / root[a, a]
                reported[q] = values[j, q]
                for a in range(k):
                    rows[q, a] = levels[j, q, a]
                for c in range(q):
                    reported[q] -= root[q, c] * reported[c]
                    for a in range(k):
                        rows[q, a] -= root[q, c] * rows[c, a]
                reported[q] /= root[q, q]
                for a in range(k):
                    rows[q, a] /= root[q, q]
            for q in range(p):
                size, off = 1.0, reported[q]
                for a in range(k):
                    lever[a] = 0.0
                    for c in range(k):
                        lever[a] += spread[a, c] * rows[q, c]
                    size += rows[q, a] * lever[a]
                    off -= rows[q, a] * state[a]
                for a in range(k):
                    state[a] += lever[a] * off / size
                    for c in range(k):
                        spread[a, c] -= lever[a] * lever[c] / size
                likely[g] -= 0.5 * (math.log(size) + off**2 / size) + math.log(root[q, q])
    return likely


_compute_grid_likelihoods = compile_kernel(_run_filter_bank)
