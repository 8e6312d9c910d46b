"""Finds the axis that is unlike its sisters: the same axis of machines of one kind, at one temperature and age.

A parameter's level of an axis is the median of its newest sets, as a part of the sisters' median. A mixed model
(:mod:`fdhil.fleet.mixed`) tells what temperature and age account for, and how far sisters differ besides; the axis'
own interval, and what is not known of its temperature, are added. The bounds are such that of a hundred groups without
an outlier one has an alarm, whatever their number (they were counted with random numbers).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.fleet import mixed
from fdhil.records import Float

LEAST_SISTERS = 5
LEVEL_SETS = 5  # the newest, of which a level is the median
WINSOR = 3.0  # deviations: what is farther off is no farther where machines are looked at as a whole
# from so many sisters on -> the largest deviation of all that is exceeded in one of 100 groups, in deviations
BOUNDS = (
    (5, 36.0), (6, 9.2), (8, 6.8), (10, 5.9), (12, 5.6), (15, 5.3), (20, 5.0), (30, 4.8), (50, 4.6), (100, 4.4)
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Course:
    """The newest sets of one parameter of an axis, oldest first: values, temperatures (NaN where unknown), all (n,).

    ``ages_months`` (n,) count from the first set, or from the newest service. ``std`` is the standard deviation of the
    newest value.
    """

    machine: str
    axis: str
    values: Float
    temperatures_c: Float
    ages_months: Float
    std: float


@dataclass(frozen=True, slots=True)
class Level:
    """Where an axis stands among its sisters: ``off`` 0.1 is 10 % above what is expected of it, ``score`` in doubts."""

    machine: str
    axis: str
    value: float
    off: float
    score: float
    is_outlier: bool


@dataclass(frozen=True, slots=True)
class Sisters:
    """A group: its median, spread as a part of it, slopes as parts per kelvin and month, the score's bound, levels.

    ``temperature_c`` and ``age_months`` are the usual ones.
    """

    median: float
    spread: float
    slope_per_k: float
    slope_per_month: float
    temperature_c: float
    age_months: float
    bound: float
    levels: tuple[Level, ...]


def judge(courses: Sequence[Course]) -> Sisters | None:
    """Return how the axes of a group stand to each other; None where they are too few, or their median is 0."""
    courses = [course for course in courses if np.isfinite(course.values[-1])]
    if len(courses) < LEAST_SISTERS:
        return None
    levels = np.array([np.median(course.values[-LEVEL_SETS:]) for course in courses])
    median = float(np.median(levels))
    if median == 0.0:
        return None
    at = np.array([[_newest(c.temperatures_c), _newest(c.ages_months)] for c in courses])
    usual, apart, unknown = _filled(at)
    shared = mixed.shared_slopes([axis for course in courses if (axis := _own(course)) is not None])
    own = np.array([course.std / median if np.isfinite(course.std) else 0.0 for course in courses]) ** 2
    found = mixed.fit(levels / median, apart, own, shared)
    # a temperature that is not known may be any that others have
    own = own + (unknown**2) @ (found.slopes**2 + found.slope_stds**2)
    scale = np.sqrt(found.spread**2 + found.doubts**2 + own)
    bound = next(bound for least, bound in reversed(BOUNDS) if len(courses) >= least)
    told = [
        Level(course.machine, course.axis, float(course.values[-1]), float(o), float(o / s), bool(abs(o) > bound * s))
        for course, o, s in zip(courses, found.off, scale, strict=True)
    ]
    told.sort(key=lambda level: -abs(level.score))
    per_k, per_month = map(float, found.slopes)
    return Sisters(median, found.spread, per_k, per_month, float(usual[0]), float(usual[1]), bound, tuple(told))


def of_machines(groups: Sequence[Sisters]) -> dict[tuple[str, str], float]:
    """Return by how much each axis is expected to be off, as the other axes of its machine are off.

    The groups are those of one parameter, one an axis letter. How much axes of one machine have in common is counted
    over all of them; there, what lies far out has no more say than what lies out.
    """
    scores: dict[str, dict[str, float]] = {}
    for group in groups:
        for level in group.levels:
            scores.setdefault(level.machine, {})[level.axis] = level.score
    alike = _in_common(list(scores.values()))
    spreads = {
        (level.machine, level.axis): level.off / level.score for g in groups for level in g.levels if level.score
    }
    expected = {}
    for machine, of_axes in scores.items():
        for axis in of_axes:
            others = [score for other, score in of_axes.items() if other != axis]
            share = alike * sum(others) / (1 + (len(others) - 1) * alike) if others else 0.0
            expected[machine, axis] = share * spreads.get((machine, axis), 0.0)
    return expected


def _in_common(machines: Sequence[Mapping[str, float]]) -> float:
    """Return the correlation of the axes of a machine, 0 where too few machines have several."""
    several = [np.clip(list(scores.values()), -WINSOR, WINSOR) for scores in machines if len(scores) > 1]
    if len(several) < LEAST_SISTERS:
        return 0.0
    alike = np.mean([(s.sum() ** 2 - s @ s) / (s.size * (s.size - 1)) for s in several])
    whole = np.mean([s @ s / s.size for s in several])
    return float(np.clip(alike / whole, 0.0, 0.95)) if whole > 0 else 0.0


def _newest(values: Float) -> float:
    known = values[-LEVEL_SETS:][np.isfinite(values[-LEVEL_SETS:])]
    return float(np.median(known)) if known.size else np.nan


def _filled(at: Float) -> tuple[Float, Float, Float]:
    """Return the usual temperature and age (2,), how far each axis (n, 2) is from them, and the doubt of that (n, 2).

    What is not known of an axis is taken for usual, within what is known of others.
    """
    known = np.isfinite(at)
    usual = np.array([np.median(column[k]) if k.any() else np.nan for column, k in zip(at.T, known.T, strict=True)])
    width = np.array([np.std(column[k]) if k.any() else 0.0 for column, k in zip(at.T, known.T, strict=True)])
    return usual, np.where(known, at - usual, 0.0), np.where(known, 0.0, width)


def _own(course: Course) -> tuple[Float, Float] | None:
    """Return an axis' sets as the shared slopes are told by: parts of its median, and its temperatures and ages.

    Where the temperature is not known nothing is: a spring that warms all of them would be taken for their age.
    """
    known = np.isfinite(course.values) & np.isfinite(course.ages_months) & np.isfinite(course.temperatures_c)
    usual = float(np.median(course.values))
    if usual == 0.0 or not np.isfinite(usual):
        return None
    return course.values[known] / usual, np.column_stack([course.temperatures_c[known], course.ages_months[known]])
