"""Forecasts a path's error from the parameters' history: when a zone leaves a tolerance, and the cost of a step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.identification import LEAST_STEP, Slope, find_crossing, fit_slope, limit_forecast_days
from fdhil.prediction.model_variants import collect_term_names, group_term_parts, restore_earlier_values
from fdhil.prediction.path_prediction import predict_contour_um, predict_path
from fdhil.records import PARAMETERS, Float, Parameters, ParameterSet, Prediction, Zone, compute_rms

BEYOND_CHANCE = 3.0  # standard deviations
GROUPS: Mapping[str, tuple[str, ...]] = {"inertia": ("Jt",), "friction": ("ft", "Cd")}
COMMON_UM = 0.01  # steps that cost less are not reported


@dataclass(frozen=True, slots=True)
class ParameterStep:
    """A sudden change of an axis' inertia or friction, and its cost on a path.

    ``changed`` maps a symbol to (before, now). ``cost_um`` is the largest change of the contour error, + worse, at
    ``line`` (0: a demand) and ``where``; ``rms_um`` the change of the whole path's RMS.
    """

    axis: str
    what: str
    changed: Mapping[str, tuple[float, float]]
    since_revision: int
    cost_um: float
    rms_um: float
    line: int
    where: str


@dataclass(frozen=True, slots=True)
class ZoneChange:
    """The change of one zone since the last comparison: its largest contour error ``before`` and ``now``, um.

    ``by`` is the effect of each changed parameter: (axis, symbol, um), the largest first; restoring it alone would undo
    that much. ``settings_um`` is the effect of a changed configuration, None where it is the same.
    """

    line: int
    where: str
    cause: str
    before_um: float
    now_um: float
    std_um: float
    by: tuple[tuple[str, str, float], ...]
    settings_um: float | None


@dataclass(frozen=True, slots=True)
class ToleranceCrossing:
    """When a zone leaves the tolerance if the trends continue: days from the newest parameters, 95 % interval.

    ``axis`` and ``parameter`` have the largest effect.
    """

    days: float
    earliest_days: float
    latest_days: float
    axis: str
    parameter: str


@dataclass(frozen=True, slots=True)
class ParameterTrend:
    """The slope per day of each of an axis' parameters that has one, and the observed days."""

    slopes: Mapping[str, Slope]
    span_days: float


def find_changed_groups(before: ParameterSet, now: ParameterSet) -> dict[str, tuple[str, ...]]:
    """Return which of ``GROUPS`` differ by more than drift and chance explain, with the symbols that do."""
    found = {}
    for what, names in GROUPS.items():
        symbols = tuple(name for name in names if _is_changed(before, now, PARAMETERS.index(name)))
        if symbols:
            found[what] = symbols
    return found


def _is_changed(before: ParameterSet, now: ParameterSet, k: int) -> bool:
    name = PARAMETERS[k]
    old, new = getattr(before.parameters, name), getattr(now.parameters, name)
    variance = np.nan_to_num(before.covariance[k, k]) + np.nan_to_num(now.covariance[k, k])
    return bool(abs(new - old) > max(LEAST_STEP[name] * abs(old), BEYOND_CHANCE * float(np.sqrt(variance))))


def find_last_step(sets: Sequence[ParameterSet]) -> int | None:
    """Return the index, in an axis' sets (oldest first), of the last one before the newest step; None without one."""
    for k in range(len(sets) - 2, -1, -1):
        if find_changed_groups(sets[k], sets[k + 1]) and find_changed_groups(sets[k], sets[-1]):
            return k
    return None


def compute_step_costs(
    prediction: Prediction,
    models: Mapping[str, Parameters],
    earlier: Mapping[str, ParameterSet],
    now: Mapping[str, ParameterSet],
    config: MachineConfig,
) -> tuple[ParameterStep, ...]:
    """Return the cost of each axis' changes of inertia and friction since ``earlier``, the largest first.

    Each is restored alone; ``models`` are those of ``prediction``, whose values ``now`` holds.
    """
    reference = prediction.reference
    steps = []
    for axis in reference.axes:
        if axis not in earlier or axis not in now:
            continue
        for what in find_changed_groups(earlier[axis], now[axis]):
            names = GROUPS[what]
            old = {name: float(getattr(earlier[axis].parameters, name)) for name in names}
            without = predict_contour_um(reference, {**models, axis: models[axis].replace_values(**old)}, config)
            change = prediction.contour_um - without
            row = int(np.argmax(np.abs(change)))
            if abs(change[row]) < COMMON_UM:
                continue
            steps.append(
                ParameterStep(
                    axis=axis,
                    what=what,
                    changed={name: (old[name], float(getattr(models[axis], name))) for name in names},
                    since_revision=earlier[axis].revision,
                    cost_um=float(change[row]),
                    rms_um=prediction.rms_um - compute_rms(without),
                    line=int(reference.line[row]),
                    where=reference.describe_position(row),
                )
            )
    return tuple(sorted(steps, key=lambda step: -abs(step.cost_um)))


def compare_zones(
    prediction: Prediction,
    models: Mapping[str, Parameters],
    earlier: Mapping[str, Parameters],
    std_um: Float,
    recorded: Sequence[tuple[Zone, float]],
    config: MachineConfig,
    same_settings: bool,
) -> tuple[ZoneChange, ...]:
    """Return the change of each zone since ``earlier`` parameters were used, including zones that are gone.

    ``compute_std_um`` (n,) is that of the present prediction; ``recorded`` are the zones as reported then, each with
    its standard deviation: if the configuration has changed since, they show its effect.
    """
    reference = prediction.reference
    then = predict_path(reference, {**models, **earlier}, config)
    without = {}
    for axis, old in earlier.items():
        for main, names in group_term_parts(collect_term_names(models[axis], old)).items():
            alone = restore_earlier_values(models[axis], old, names)
            if alone != restore_earlier_values(models[axis], models[axis], names):
                without[axis, main] = predict_contour_um(reference, {**models, axis: alone}, config)
    gone = [zone for zone in then.zones if not any(_is_overlapping(zone, other) for other in prediction.zones)]
    changes = []
    for zone in sorted((*prediction.zones, *gone), key=lambda zone: zone.start_s):
        rows = prediction.get_zone_rows(zone)
        peak = rows.start + int(np.argmax(np.maximum(prediction.contour_um, then.contour_um)[rows]))
        now_um, before_um = float(prediction.contour_um[rows].max()), float(then.contour_um[rows].max())
        by = ((axis, name, now_um - float(other[rows].max())) for (axis, name), other in without.items())
        earlier_zones = [(other.max_um, std) for other, std in recorded if _is_overlapping(zone, other)]
        settings_um = before_um - max(earlier_zones)[0] if earlier_zones and not same_settings else None
        std_then = max(earlier_zones)[1] if earlier_zones else float(std_um[peak])
        change = ZoneChange(
            line=int(reference.line[peak]),
            where=zone.where,
            cause=zone.cause,
            before_um=before_um - (settings_um or 0.0),
            now_um=now_um,
            std_um=float(np.hypot(std_um[peak], std_then)),
            by=tuple(sorted(by, key=lambda item: -abs(item[2]))),
            settings_um=settings_um,
        )
        changes.append(change)
    return tuple(changes)


def _is_overlapping(zone: Zone, other: Zone) -> bool:
    return zone.start_s < other.end_s and zone.end_s > other.start_s


def fit_parameter_trend(sets: Sequence[ParameterSet], days: Float) -> ParameterTrend:
    """Return the trends of an axis' parameters, from its sets published on ``days`` (n,).

    Sets before the last step are ignored, and a change that follows a known temperature is not a trend in time.
    """
    step = find_last_step(sets)
    first = 0 if step is None else step + 1
    newest = sets[first:]
    celsius = np.array([np.nan if s.temperature_c is None else s.temperature_c for s in newest], dtype=np.float64)
    celsius_known = celsius if np.isfinite(celsius).all() and np.ptp(celsius) > 0 else None
    found = {}
    for k, name in enumerate(PARAMETERS):
        values = np.array([getattr(s.parameters, name) for s in newest])
        stds = np.array([np.sqrt(max(float(np.nan_to_num(s.covariance[k, k])), 0.0)) for s in newest])
        line = fit_slope(values, days[first:], stds if (stds > 0).all() else None, celsius_known)
        if line is not None:
            found[name] = line
    return ParameterTrend(found, float(np.ptp(days[first:])))


def compute_observed_days(courses: Mapping[str, ParameterTrend]) -> float:
    """Return the days that every axis with a trend has been observed; 0 without any."""
    return min((known.span_days for known in courses.values() if known.slopes), default=0.0)


def predict_tolerance_crossing(
    zone: Zone,
    um_per_percent: Mapping[str, Mapping[str, float]],
    models: Mapping[str, Parameters],
    courses: Mapping[str, ParameterTrend],
    tolerance_um: float,
) -> ToleranceCrossing | None:
    """Return when the zone's largest error crosses the tolerance, to first order; None if that is not foreseeable.

    It is not if the error falls, if its slope may as well be zero, or if the day is farther ahead than the history
    reaches. The zone must be within the tolerance now.
    """
    rates: dict[tuple[str, str], float] = {}
    variance = 0.0
    for axis, known in courses.items():
        for name, line in known.slopes.items():
            value = abs(float(getattr(models[axis], name)))
            if value == 0.0:
                continue
            um_per_unit = 100.0 * um_per_percent[axis][name] / value
            rates[axis, name] = line.value * um_per_unit
            variance += (line.std * um_per_unit) ** 2
    rate = sum(rates.values())
    if rate <= 0.0:
        return None
    freedom = min(line.freedom for known in courses.values() for line in known.slopes.values())
    line = Slope(rate, float(np.sqrt(variance)), at=0.0, level=zone.max_um, freedom=freedom)
    found = find_crossing(line, tolerance_um)
    if found is None or found.at > limit_forecast_days(compute_observed_days(courses)):
        return None
    axis, name = max(rates, key=rates.__getitem__)
    return ToleranceCrossing(found.at, found.low, found.high, axis, name)
