"""Finds by how much a drive's parameters differ between its windows, from the drive's own history.

What warms moves on from window to window: R, ft and Cd go random walks, in shares of their size. Beside that, windows
scatter more than each of them tells when the drive does what no model has: a random effect (Paule, Mandel 1982). Sizes
are not chosen but weighed: each of a grid by the restricted likelihood of the newest windows (Patterson, Thompson
1971) and by a prior that gives no difference at all a fair chance. The mean of the variances is what a pool counts
with: few windows leave much open, and are told so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.records import Float

HISTORY = 24  # windows: what came before says little of how fast the drive warms now
FOR_BOTH_SLOPES = 3  # windows in either direction from which on viscous friction may differ by it
# shares of a parameter's size; steps of a factor two, as finer ones change no interval by a tenth
STEPS = np.array([0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064])
SCATTERS = np.array([0.0, 0.003, 0.01, 0.03])
SMALL_SCATTERS = np.array([0.0, 0.0005, 0.002, 0.008])
SURELY = 6.9  # logarithm of a ratio of likelihoods: two sizes more explain so much by chance once in a thousand
NO_SCATTER = 0.9  # prior chance that there is no scatter at all


@dataclass(frozen=True, slots=True)
class Member:
    """What one window of a drive tells: ``values`` (k,) of ``names`` with the covariance (k, k) of its ``own`` chance.

    ``shared`` (k, q) are doubts that all windows of the drive share, one standard deviation a column. ``place`` counts
    the windows, ``direction`` is 1 or -1.
    """

    names: tuple[str, ...]
    values: Float
    own: Float
    shared: Float
    place: int
    direction: int

    def part(self, names: Sequence[str]) -> tuple[Float, Float]:
        """Return values (p,) and own covariance (p, p) of some names."""
        rows = [self.names.index(name) for name in names]
        return self.values[rows], self.own[np.ix_(rows, rows)]


@dataclass(frozen=True, slots=True)
class Between:
    """Variances of what differs between windows, by name, in squared shares of the parameter's size in ``sizes``.

    A name's ``walk`` is added for each window that lies between two, its ``scatter`` for each window by itself.
    ``surely`` says that no difference at all is beyond chance.
    """

    sizes: dict[str, float]
    walk: dict[str, float]
    scatter: dict[str, float]
    surely: bool


ALIKE = Between({}, {}, {}, surely=False)
"""Windows that differ by their own chance alone."""


@dataclass(frozen=True, slots=True)
class Kind:
    """Parameters that differ together, and the grid of what they may do.

    ``steady`` is the prior chance that they do not walk at all.
    """

    names: tuple[str, ...]
    steps: Float
    scatters: Float
    steady: float = 1.0

    def grid(self) -> tuple[Float, Float]:
        """Return (g, 2) shares of walk and scatter, and the logarithms (g,) of their prior chances."""
        pairs = np.array([(walk, scatter) for walk in self.steps for scatter in self.scatters])
        chances = np.outer(_chances(self.steps, self.steady), _chances(self.scatters, NO_SCATTER))
        return pairs, np.log(chances.ravel())


def _chances(sizes: Float, none: float) -> Float:
    """Return the prior chance of each size: that of the first, 0, and what is left for the others alike."""
    others = sizes.size - 1
    return np.array([none, *[(1.0 - none) / others] * others]) if others else np.ones(1)


_NONE = np.zeros(1)
KINDS = (
    Kind(("R",), STEPS, _NONE, 0.7),
    Kind(("L",), _NONE, SMALL_SCATTERS),
    Kind(("K",), _NONE, SMALL_SCATTERS),
    Kind(("Jt",), _NONE, SMALL_SCATTERS),
    Kind(("ft", "Cd"), STEPS, SCATTERS, 0.3),
)


def between(members: Sequence[Member]) -> Between:
    """Return by how much the parameters differ between windows that are given in order; only the newest count."""
    newest = members[-HISTORY:]
    sizes: dict[str, float] = {}
    walk: dict[str, float] = {}
    scatter: dict[str, float] = {}
    surely = False
    for kind in KINDS:
        telling = [m for m in newest if set(kind.names) <= set(m.names)]
        if len(telling) < 2:
            continue
        likely, prior, pairs, typical = _weighed(telling, kind)
        weights = np.exp(likely + prior - (likely + prior).max())
        found = weights @ pairs**2 / weights.sum()
        surely = surely or float(likely.max() - likely[0]) > SURELY
        for name, size in zip(kind.names, typical, strict=True):
            sizes[name], walk[name], scatter[name] = float(size), float(found[0]), float(found[1])
    return Between(sizes, walk, scatter, surely)


def _weighed(members: Sequence[Member], kind: Kind) -> tuple[Float, Float, Float, Float]:
    """Return log-likelihoods (g,) and log prior chances (g,) of the grid (g, 2), and the parameters' sizes (p,)."""
    told = [m.part(kind.names) for m in members]
    values = np.array([value for value, _ in told])
    typical = np.median(np.abs(values), axis=0)
    typical[typical == 0.0] = 1.0
    owns = np.array([own for _, own in told]) / np.outer(typical, typical)
    pairs, prior = kind.grid()
    known = np.concatenate([_levels(members, kind), (values / typical)[:, :, None]], axis=2)
    likely = _restricted(owns, known, np.array([m.place for m in members], dtype=np.float64), pairs)
    return likely, prior, pairs, typical


def _levels(members: Sequence[Member], kind: Kind) -> Float:
    """Return what is the same in all windows (n, p, k): each level, and what friction owes to the direction.

    Where the load is not known yet, a difference of sign is no scatter.
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


def _restricted(owns: Float, known: Float, places: Float, pairs: Float) -> Float:
    """Return the restricted log-likelihood (g,) of each pair of walk and scatter.

    ``owns`` (n, p, p) are the windows' covariances, ``known`` (n, p, k + 1) the levels' columns and then the values.
    """
    n, p, _ = known.shape
    own = np.zeros((n, p, n, p))
    own[np.arange(n), :, np.arange(n), :] = owns
    steps = places - places[0]
    walk = np.kron(np.minimum.outer(steps, steps), np.eye(p))
    spread = own.reshape(n * p, n * p) + pairs[:, :1, None] ** 2 * walk + pairs[:, 1:, None] ** 2 * np.eye(n * p)
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, np.broadcast_to(known.reshape(n * p, -1), (len(pairs), n * p, known.shape[2])))
    levels, values = white[:, :, :-1], white[:, :, -1:]
    triangle = np.linalg.cholesky(levels.transpose(0, 2, 1) @ levels)
    followed = np.linalg.solve(triangle, levels.transpose(0, 2, 1) @ values)
    left = np.square(values).sum(axis=(1, 2)) - np.square(followed).sum(axis=(1, 2))
    logs = sum(np.log(np.diagonal(each, axis1=1, axis2=2)).sum(axis=1) for each in (root, triangle))
    likely: Float = -0.5 * left - logs
    return likely
