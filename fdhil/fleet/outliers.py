"""Finds axes that deviate from comparable axes: the same axis of machines of one kind, at one temperature and age.

The level of an axis is the median of its newest values of a parameter, relative to the median of its peers. A mixed
model (:mod:`fdhil.fleet.mixed_model`) accounts for temperature and age and estimates the remaining spread; the axis'
own uncertainty, and that of an unknown temperature, are added. The bounds give a false alarm in one of a hundred groups
without an outlier, whatever their size (found by simulation).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.fleet import mixed_model
from fdhil.records import Float

LEAST_PEERS = 5
LEVEL_SETS = 5  # newest sets whose median is the level
WINSOR = 3.0  # limit of the deviations in the correlation between axes of a machine
# least number of peers, and the largest deviation that one of 100 groups exceeds, in standard deviations
BOUNDS = (
    (5, 36.0), (6, 9.2), (8, 6.8), (10, 5.9), (12, 5.6), (15, 5.3), (20, 5.0), (30, 4.8), (50, 4.6), (100, 4.4)
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ParameterHistory:
    """The newest values of one parameter of an axis, oldest first, with temperatures (NaN where unknown), all (n,).

    ``compute_ages_months`` (n,) count from the first set, or from the newest service. ``std`` is the standard deviation
    of the newest value.
    """

    machine: str
    axis: str
    values: Float
    temperatures_c: Float
    ages_months: Float
    std: float


@dataclass(frozen=True, slots=True)
class AxisDeviation:
    """Position of an axis among its peers: ``off`` 0.1 is 10 % above its expected value, ``score`` in deviations."""

    machine: str
    axis: str
    value: float
    off: float
    score: float
    is_outlier: bool


@dataclass(frozen=True, slots=True)
class PeerGroup:
    """A group of comparable axes: median, relative spread, slopes per kelvin and month, bound of the score, levels.

    ``temperature_c`` and ``age_months`` are the medians of the group.
    """

    median: float
    spread: float
    slope_per_k: float
    slope_per_month: float
    temperature_c: float
    age_months: float
    bound: float
    levels: tuple[AxisDeviation, ...]


def assess_peers(courses: Sequence[ParameterHistory]) -> PeerGroup | None:
    """Compare the axes of a group; None where they are too few, or their median is 0."""
    courses = [course for course in courses if np.isfinite(course.values[-1])]
    if len(courses) < LEAST_PEERS:
        return None
    levels = np.array([np.median(course.values[-LEVEL_SETS:]) for course in courses])
    median = float(np.median(levels))
    if median == 0.0:
        return None
    at = np.array([[_compute_recent_median(c.temperatures_c), _compute_recent_median(c.ages_months)] for c in courses])
    usual, apart, unknown = _fill_unknown_covariates(at)
    shared = mixed_model.estimate_shared_slopes(
        [axis for course in courses if (axis := _normalise_history(course)) is not None]
    )
    own = np.array([course.std / median if np.isfinite(course.std) else 0.0 for course in courses]) ** 2
    found = mixed_model.fit_mixed_model(levels / median, apart, own, shared)
    # an unknown temperature may be any of the others'
    own = own + (unknown**2) @ (found.slopes**2 + found.slope_stds**2)
    scale = np.sqrt(found.spread**2 + found.deviation_stds**2 + own)
    bound = next(bound for least, bound in reversed(BOUNDS) if len(courses) >= least)
    levels_found = [
        AxisDeviation(
            course.machine, course.axis, float(course.values[-1]), float(o), float(o / s), bool(abs(o) > bound * s)
        )
        for course, o, s in zip(courses, found.deviations, scale, strict=True)
    ]
    levels_found.sort(key=lambda level: -abs(level.score))
    per_k, per_month = map(float, found.slopes)
    return PeerGroup(
        median, found.spread, per_k, per_month, float(usual[0]), float(usual[1]), bound, tuple(levels_found)
    )


def predict_from_other_axes(groups: Sequence[PeerGroup]) -> dict[tuple[str, str], float]:
    """Return the deviation expected of each axis from the deviations of the other axes of its machine.

    The groups are those of one parameter, one per axis letter. The correlation between the axes of a machine is
    estimated over all machines, with scores limited to WINSOR.
    """
    scores: dict[str, dict[str, float]] = {}
    for group in groups:
        for level in group.levels:
            scores.setdefault(level.machine, {})[level.axis] = level.score
    common = _estimate_common_correlation(list(scores.values()))
    spreads = {
        (level.machine, level.axis): level.off / level.score for g in groups for level in g.levels if level.score
    }
    expected = {}
    for machine, of_axes in scores.items():
        for axis in of_axes:
            others = [score for other, score in of_axes.items() if other != axis]
            share = common * sum(others) / (1 + (len(others) - 1) * common) if others else 0.0
            expected[machine, axis] = share * spreads.get((machine, axis), 0.0)
    return expected


def _estimate_common_correlation(machines: Sequence[Mapping[str, float]]) -> float:
    """Return the correlation between the axes of a machine, 0 where too few machines have several."""
    several = [np.clip(list(scores.values()), -WINSOR, WINSOR) for scores in machines if len(scores) > 1]
    if len(several) < LEAST_PEERS:
        return 0.0
    common = np.mean([(s.sum() ** 2 - s @ s) / (s.size * (s.size - 1)) for s in several])
    whole = np.mean([s @ s / s.size for s in several])
    return float(np.clip(common / whole, 0.0, 0.95)) if whole > 0 else 0.0


def _compute_recent_median(values: Float) -> float:
    known = values[-LEVEL_SETS:][np.isfinite(values[-LEVEL_SETS:])]
    return float(np.median(known)) if known.size else np.nan


def _fill_unknown_covariates(at: Float) -> tuple[Float, Float, Float]:
    """Return the usual temperature and age (2,), each axis' difference (n, 2) and its uncertainty (n, 2).

    Unknown covariates are taken as usual, with the spread of the known ones as uncertainty.
    """
    known = np.isfinite(at)
    usual = np.array([np.median(column[k]) if k.any() else np.nan for column, k in zip(at.T, known.T, strict=True)])
    width = np.array([np.std(column[k]) if k.any() else 0.0 for column, k in zip(at.T, known.T, strict=True)])
    return usual, np.where(known, at - usual, 0.0), np.where(known, 0.0, width)


def _normalise_history(course: ParameterHistory) -> tuple[Float, Float] | None:
    """Return an axis' values relative to its median, with temperatures and ages, for the shared slopes.

    Sets of unknown temperature are left out: otherwise a seasonal warming would be taken for ageing.
    """
    known = np.isfinite(course.values) & np.isfinite(course.ages_months) & np.isfinite(course.temperatures_c)
    usual = float(np.median(course.values))
    if usual == 0.0 or not np.isfinite(usual):
        return None
    return course.values[known] / usual, np.column_stack([course.temperatures_c[known], course.ages_months[known]])
