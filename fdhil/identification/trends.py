"""Analyses a parameter's history: its slope, its steps, when it reaches a limit, each with an interval."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.records import INTERVAL_95, PARAMETERS, Float

LEAST_ROWS = 3
LEAST_STRETCH = 3  # rows on either side of a step: fewer may be a single bad estimate
NEWEST = 2  # rows after the newest step: two that agree are accepted
ENOUGH_FOR_DRIFT = 8  # rows from which on a steady drift is distinguished from a step
ENOUGH_FOR_CURVE = 16
NEAR = 8  # rows on either side in which a step must be visible too
BEYOND_CHANCE = 5.0
# a date is predicted only from a significant slope, over a minimum span, and only so far ahead
SURE_SLOPE = 3.0  # standard deviations
LEAST_DAYS = 1.0
FARTHEST_SPANS = 5.0
COLLINEAR = 1e-4  # share of a covariate that must be independent of the others
FRICTION_AT_RAPID = (
    "friction_at_rapid"  # Cd + ft w at the rapid speed: well determined where ft and Cd compensate each other
)
BY_DIRECTION = ("ft", "Cd", FRICTION_AT_RAPID)
LEAST_TURNS = 3  # least changes of direction
# smaller steps are not reported: nonlinear drift resembles them
LEAST_STEP: dict[str, float] = {
    "R": 0.05,
    "L": 0.08,
    "K": 0.03,
    "Jt": 0.02,
    "ft": 0.15,
    "Cd": 0.10,
    FRICTION_AT_RAPID: 0.10,
}
LEAST_STEP |= {f"{name}/K": LEAST_STEP[name] for name in ("Jt", "ft", "Cd")}  # K hardly changes


@dataclass(frozen=True, slots=True)
class Slope:
    """A line through a parameter's history: slope ``value`` with ``std``.

    The line passes through ``level`` (with ``level_std``, independent of the slope's) at ``at``. ``freedom`` is the
    degrees of freedom of the standard deviations, infinite when they come from the estimates themselves.
    """

    value: float
    std: float
    at: float
    level: float
    level_std: float = 0.0
    freedom: float = math.inf

    def compute_interval(self) -> tuple[float, float]:
        """Return the slope's 95 % interval."""
        half = compute_student_95(self.freedom) * self.std
        return self.value - half, self.value + half


@dataclass(frozen=True, slots=True)
class Crossing:
    """Where a line reaches a limit, with its 95 % interval, in units of the line's abscissa."""

    at: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Step:
    """A step of a parameter between rows ``row - 1`` and ``row``: by ``size`` with ``std``, from ``before`` on."""

    name: str
    row: int
    size: float
    std: float
    before: float


def compute_student_95(freedom: float) -> float:
    """Return the quantile of Student's t that leaves 2.5 % on either side (Cornish-Fisher; within 1 % from 3 on)."""
    if math.isinf(freedom):
        return INTERVAL_95
    z, v = INTERVAL_95, max(freedom, 1.0)
    terms = (z, (z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384)
    return sum(term / v**k for k, term in enumerate(terms))


def fit_slope(points: Float, against: Float, stds: Float | None = None, covariate: Float | None = None) -> Slope | None:
    """Fit a line to ``points`` (n,) over ``against`` (n,), weighted by ``stds`` (n,); None without a slope.

    The effect of the ``covariate`` (n,) does not count towards the slope. The standard deviation is the larger of
    that by ``stds`` and that by the scatter about the line.
    """
    known = np.isfinite(points) & np.isfinite(against)
    if covariate is not None:
        known &= np.isfinite(covariate)
    y, x = points[known], against[known]
    terms = 2 if covariate is None else 3
    if y.size <= terms - 1 + (terms == 2) or np.ptp(x) == 0.0:
        return None
    weights = np.ones(y.size) if stds is None else 1.0 / np.maximum(stds[known], 1e-300) ** 2
    at, level = (float(np.average(values, weights=weights)) for values in (x, y))
    root = np.sqrt(weights)
    lever, left = root * (x - at), root * (y - level)
    whole = float(lever @ lever)
    if covariate is not None:
        other = covariate[known] - np.average(covariate[known], weights=weights)
        lever, left = (_remove_component(root * other, column) for column in (lever, left))
    spread = float(lever @ lever)
    if not spread > COLLINEAR * whole:
        return None
    value = float(lever @ left) / spread
    scatter = float(((left - value * lever) ** 2).sum()) / (y.size - terms) if y.size > terms else math.inf
    inflation = scatter if stds is None else max(1.0, scatter)
    promised = stds is not None and scatter <= 1.0
    freedom = math.inf if promised else float(y.size - terms)
    level_std = math.sqrt(inflation / float(weights.sum()))
    return Slope(value, math.sqrt(inflation / spread), at, level, level_std, freedom)


def _remove_component(other: Float, column: Float) -> Float:
    length = float(other @ other)
    return column - other * (float(other @ column) / length if length > 0 else 0.0)


def remove_direction_bias(points: Float, direction: Float) -> Float:
    """Return ``points`` (n,) less the effect of the ``direction`` (n,), 1 or -1: a constant load, a screw's bias.

    It is half the median difference between consecutive windows of opposite directions, which excludes drift and steps;
    0 with fewer than ``LEAST_TURNS``.
    """
    known = np.isfinite(points)
    y, side = points[known], direction[known]
    turns = np.flatnonzero(side[1:] != side[:-1])
    if turns.size < LEAST_TURNS:
        return points
    load = float(np.median(side[turns] * (y[turns] - y[turns + 1]) / 2))
    return points - load * direction


def find_crossing(line: Slope, limit: float) -> Crossing | None:
    """Return where the line reaches ``limit``, by Fieller's theorem; None for an insignificant slope."""
    sure = compute_student_95(line.freedom) ** 2
    if line.value**2 <= sure * (SURE_SLOPE / INTERVAL_95 * line.std) ** 2:
        return None
    apart = limit - line.level
    a = line.value**2 - sure * line.std**2
    b = line.value * apart
    c = apart**2 - sure * line.level_std**2
    root = math.sqrt(max(b * b - a * c, 0.0))
    return Crossing(line.at + apart / line.value, line.at + (b - root) / a, line.at + (b + root) / a)


def limit_forecast_days(span_days: float) -> float:
    """Return how many days ahead a slope observed over ``span_days`` may be extrapolated; 0 for too short a span."""
    return FARTHEST_SPANS * span_days if span_days >= LEAST_DAYS else 0.0


def find_steps(
    values: Float, stds: Float, temperature: Float | None = None, names: Sequence[str] = PARAMETERS
) -> list[Step]:
    """Return the steps of the parameters ``names`` (n, k) with ``stds`` (n, k), by row; rows are windows in order.

    Steady drift, a slow curve and the effect of ``temperature`` (n,) are not steps.
    """
    found = [
        s for k, name in enumerate(names) for s in _find_parameter_steps(name, values[:, k], stds[:, k], temperature)
    ]
    return sorted(found, key=lambda step: (step.row, names.index(step.name)))


def _find_parameter_steps(name: str, values: Float, stds: Float, temperature: Float | None) -> list[Step]:
    known = np.flatnonzero(np.isfinite(values) & np.isfinite(stds) & (stds > 0))
    y, n = values[known], known.size
    if n < LEAST_STRETCH + NEWEST:
        return []
    weights = 1.0 / stds[known]
    columns = _build_smooth_columns(n, None if temperature is None else temperature[known])
    rows: list[int] = []
    least = LEAST_STEP[name] * float(np.median(np.abs(y)))
    while (row := _find_best_row(y * weights, weights, [*columns, *_build_step_columns(n, rows)], rows)) is not None:
        theta, covariance = _fit_weighted(y * weights, weights, [*columns, *_build_step_columns(n, [*rows, row])])
        sure = abs(theta[-1]) >= max(least, BEYOND_CHANCE * math.sqrt(covariance[-1, -1]))
        if not (sure and _is_locally_visible(y, weights, row, theta[-1])):
            break
        rows.append(row)
    if not rows:
        return []
    theta, covariance = _fit_weighted(y * weights, weights, [*columns, *_build_step_columns(n, rows)])
    stepped = zip(rows, theta[len(columns) :], np.sqrt(np.diag(covariance))[len(columns) :], strict=True)
    base = np.column_stack([*columns, *_build_step_columns(n, rows)]) @ theta
    return [Step(name, int(known[r]), float(s), float(d), float(base[r] - s)) for r, s, d in stepped if abs(s) >= least]


def _is_locally_visible(y: Float, weights: Float, row: int, size: float) -> bool:
    """Return whether the rows near a step show it too: a smooth curve that is not a parabola has none there."""
    first, last = max(0, row - NEAR), min(y.size, row + NEAR)
    columns = [
        np.ones(last - first),
        np.linspace(-1.0, 1.0, last - first),
        *_build_step_columns(last - first, [row - first]),
    ]
    if last - first < ENOUGH_FOR_DRIFT:
        del columns[1]
    theta, _ = _fit_weighted(y[first:last] * weights[first:last], weights[first:last], columns)
    return bool(theta[-1] * size > 0 and abs(theta[-1]) >= abs(size) / 2)


def _build_smooth_columns(n: int, temperature: Float | None) -> list[Float]:
    order = np.linspace(-1.0, 1.0, n)
    columns = [np.ones(n)]
    if n >= ENOUGH_FOR_DRIFT:
        columns.append(order)
    if n >= ENOUGH_FOR_CURVE:
        columns += [order**2, order**3]
    if temperature is not None and np.isfinite(temperature).all() and n >= ENOUGH_FOR_DRIFT:
        columns.append(temperature - temperature.mean())
    return columns


def _build_step_columns(n: int, rows: Sequence[int]) -> list[Float]:
    return [(np.arange(n) >= row).astype(np.float64) for row in rows]


def _fit_weighted(y: Float, weights: Float, columns: Sequence[Float]) -> tuple[Float, Float]:
    phi = np.column_stack(columns) * weights[:, None]
    inverse = np.linalg.pinv(phi.T @ phi)
    theta = inverse @ (phi.T @ y)
    freedom = max(1, y.size - phi.shape[1])
    scatter = float(((y - phi @ theta) ** 2).sum()) / freedom
    return theta, inverse * max(1.0, scatter)


def _find_best_row(y: Float, weights: Float, columns: Sequence[Float], taken: Sequence[int]) -> int | None:
    n = y.size
    base = np.linalg.qr(np.column_stack(columns) * weights[:, None])[0]
    left = y - base @ (base.T @ y)
    # products with a weighted step from row s are sums from s to the end
    lever = np.cumsum((left * weights)[::-1])[::-1]
    shadow = np.cumsum((base * weights[:, None])[::-1], axis=0)[::-1]
    whole = np.cumsum((weights**2)[::-1])[::-1]
    length = whole - (shadow**2).sum(axis=1)
    allowed = length > COLLINEAR * whole
    allowed[n - NEWEST + 1 :] = False
    for edge in (0, *taken):
        allowed[max(0, edge - LEAST_STRETCH + 1) : edge + LEAST_STRETCH] = False
    if not allowed.any():
        return None
    power = np.where(allowed, lever**2 / np.where(allowed, length, 1.0), -1.0)
    return int(power.argmax())
