"""Finds zones: parts of the path whose contour error stands out, where they are and what causes them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from fdhil.records import Bool, Float, Int, Trajectory, Zone

# an error stands out above this share of the largest one, and never below a micrometre
SHARE = 0.05
FLOOR_UM = 1.0
# times in units of the slowest position loop's, 1 / Kv: an event explains errors shortly before it (the NC's
# smoothing) and until the loops have settled, most of all while it is RECENT; events closer than TOGETHER count
# as one
BEFORE, AFTER, RECENT, TOGETHER = 2.5, 10.0, 5.0, 2.0
TURNING_RAD_S = 0.1  # less is straight: a radius of 2 m at 12 m/min
CHANGED = 0.5  # of the acceleration across the path: a larger change of it is a corner
BACK_RAD = np.deg2rad(179.0)  # in one row: the path returns along its own line, a reversal
MOST_OF_IT = 0.5  # of an error that remains without dry friction: above, friction is not its cause
CHANGE = 1e-6  # of the largest speed, from one row to the next: less is none
PAUSE_S = 0.01  # shorter rests are no stop
MERGE_S = 0.03
SHORTEST_S = 0.003
TO_REST = ("stop", "start")

CAUSES = ("saturation", "corner", "start", "stop", "reversal", "circular lag", "straight")


@dataclass(frozen=True, slots=True)
class PathGeometry:
    """The geometry of a reference, (n,) each: path speed in mm/s, turn rate in rad/s, and the rows of its events.

    ``arc``: it turns, and not in a corner.
    """

    speed: Float
    turn_rate: Float
    events: dict[str, Bool]
    arc: Bool


def analyse_geometry(reference: Trajectory, loop_s: float) -> PathGeometry:
    """Find starts, stops, corners and reversals of a reference; ``loop_s`` is the time of the drives' loops."""
    dt = reference.dt_s
    path = reference.path_mm
    velocity = np.zeros_like(path)
    velocity[:-1] = np.diff(path, axis=0) / dt
    speed = np.linalg.norm(velocity, axis=1)
    moving = speed > 1e-3 * max(float(speed.max()), 1e-9)
    # at a reversal an axis stands still for an instant: that is no stop
    step = np.diff(_close_gaps(moving, PAUSE_S, dt).astype(np.int8), prepend=0, append=0)
    start, stop = step[:-1] == 1, np.zeros(len(path), dtype=np.bool_)
    stop[np.clip(np.flatnonzero(step == -1), 0, len(path) - 1)] = True
    change = np.diff(speed, append=0.0)
    start |= _mark_speed_changes(start[::-1], change[::-1] > CHANGE * speed.max())[::-1]
    stop |= _mark_speed_changes(stop, change < -CHANGE * speed.max())
    turn_rate = _compute_turn_rate(velocity, speed, moving, dt)
    turn_rate = np.where(turn_rate * dt > BACK_RAD, 0.0, turn_rate)
    turning = _close_gaps(turn_rate > TURNING_RAD_S, TOGETHER * loop_s, dt)
    corner = _close_gaps(
        _detect_corners(velocity, turn_rate, speed, loop_s, dt) & ~start & ~stop, TOGETHER * loop_s, dt
    )
    reversal = np.any([_detect_reversals(velocity[:, a]) for a in range(path.shape[1])], axis=0)
    events = {"start": start, "stop": stop, "corner": corner, "reversal": reversal}
    return PathGeometry(speed, turn_rate, events, turning & ~corner)


def _mark_speed_changes(events: Bool, changing: Bool) -> Bool:
    """Mark the continuous change of speed that leads to an event: a braking axis has an error before it stops."""
    here = changing | events | np.roll(events, -1)
    run = np.cumsum(np.diff(here.astype(np.int8), prepend=0) == 1)  # the number of the last run that has begun
    last = np.zeros(int(run[-1]) + 1, dtype=np.int64)
    rows = np.flatnonzero(events)
    last[run[rows]] = rows  # the last event of a run is the last to be written
    return np.asarray(here & (np.arange(events.size) <= last[run]))


def _compute_turn_rate(velocity: Float, speed: Float, moving: Bool, dt: float) -> Float:
    """Return the angle between successive directions of motion, per second; 0 at rest."""
    unit = velocity / np.maximum(speed, 1e-12)[:, None]
    chord = np.linalg.norm(np.diff(unit, axis=0), axis=1)
    angle = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    rate = np.zeros(len(speed))
    rate[:-1] = np.where(moving[:-1] & moving[1:], angle, 0.0) / dt
    return rate


def _close_gaps(rows: Bool, gap_s: float, dt: float) -> Bool:
    return rows | (_mark_near(rows, gap_s, 0.0, dt) & _mark_near(rows, 0.0, gap_s, dt))


def _detect_corners(velocity: Float, turn_rate: Float, speed: Float, loop_s: float, dt: float) -> Bool:
    """Mark rows at which the curvature changes by more than the loops can follow.

    A turn begins, ends, tightens, or changes its side or plane. Changes within the loops' time count as one, so that
    the chords of a circle are a circle; a change counts by its acceleration across the path, against the largest one
    around.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d  # not needed by identification

    half, around = max(1, round(TOGETHER * loop_s / dt)), round(AFTER * loop_s / dt)
    pace = np.maximum(uniform_filter1d(speed, half), 1e-9)
    rate = uniform_filter1d(turn_rate, half)
    across = maximum_filter1d(np.where(rate > TURNING_RAD_S, rate * pace, 0.0), 2 * around + 1)
    unit = velocity / np.maximum(speed, 1e-12)[:, None]
    change = np.zeros(speed.size)
    # the turn rate in each plane of two axes, with its sign
    for a, b in combinations(range(velocity.shape[1]), 2):
        plane = unit[:-1, a] * unit[1:, b] - unit[:-1, b] * unit[1:, a]
        curvature = uniform_filter1d(np.append(np.where(turn_rate[:-1] > 0.0, plane, 0.0), 0.0) / dt, half) / pace
        change += (maximum_filter1d(curvature, half) - minimum_filter1d(curvature, half)) ** 2
    return np.asarray((np.sqrt(change) * pace**2 > CHANGED * across) & (across > 0.0))


def _detect_reversals(velocity: Float) -> Bool:
    """Mark rows at which an axis changes its direction, whether or not it rests in between."""
    found = np.zeros(velocity.size, dtype=np.bool_)
    going = np.flatnonzero(np.abs(velocity) > 1e-6 * max(float(np.abs(velocity).max()), 1e-12))
    signs = np.sign(velocity[going])
    found[going[1:][signs[1:] != signs[:-1]]] = True
    return found


def find_zones(
    reference: Trajectory,
    contour_um: Float,
    limited: Float,
    loop_s: float,
    above_um: float | None = None,
    without_friction: Callable[[], Float] | None = None,
) -> tuple[Zone, ...]:
    """Return the zones in the order of time; ``limited`` (n,) is the share of each cycle with a limit acting.

    ``loop_s`` is the slowest position loop's time, 1 / Kv. ``above_um``: every error above it belongs to a zone;
    default: errors that stand out against the largest. ``without_friction`` gives the contour error (n,) um without dry
    friction; without it, every error near a reversal is attributed to friction.
    """
    above = contour_um > (max(FLOOR_UM, SHARE * float(contour_um.max())) if above_um is None else above_um)
    if not above.any():
        return ()
    dt = reference.dt_s
    shape = analyse_geometry(reference, loop_s)
    cause = _classify_causes(shape, limited, loop_s, dt)
    _revise_causes(cause, _find_spans(above, cause, dt), shape, reference, contour_um, loop_s, without_friction)
    runs = [
        _ZoneSpan(first, last, CAUSES[cause[first] % len(CAUSES)], _find_peak(contour_um, first, last))
        for first, last in _find_spans(above, cause, dt)
    ]
    runs = _merge_corners(runs, shape, contour_um, loop_s, dt)
    return tuple(_build_zone(reference, shape, contour_um, run, loop_s) for run in runs)


@dataclass(frozen=True, slots=True)
class _ZoneSpan:
    """Rows of one cause, half open, and the row of their largest error."""

    first: int
    last: int
    cause: str
    peak: int


def _find_peak(contour_um: Float, first: int, last: int) -> int:
    return first + int(np.argmax(contour_um[first:last]))


def _find_sharpest_turn(shape: PathGeometry, peak: int, loop_s: float, dt: float) -> int:
    """Return the row with the largest turn rate just before an error."""
    begin = max(0, peak - round(RECENT * loop_s / dt))
    return begin + int(np.argmax(shape.turn_rate[begin : peak + round(BEFORE * loop_s / dt) + 1]))


def _merge_corners(
    runs: Sequence[_ZoneSpan], shape: PathGeometry, contour_um: Float, loop_s: float, dt: float
) -> list[_ZoneSpan]:
    """Merge the zones at the beginning and at the end of the same turn if one follows the other."""
    joined: list[_ZoneSpan] = []
    for run in runs:
        before = joined[-1] if joined else None
        if before is not None and before.cause == run.cause == "corner" and run.first - before.last <= MERGE_S / dt:
            apart = abs(
                _find_sharpest_turn(shape, run.peak, loop_s, dt) - _find_sharpest_turn(shape, before.peak, loop_s, dt)
            )
            if apart <= RECENT * loop_s / dt:
                joined[-1] = _ZoneSpan(
                    before.first, run.last, run.cause, _find_peak(contour_um, before.first, run.last)
                )
                continue
        joined.append(run)
    return joined


def _classify_causes(shape: PathGeometry, limited: Float, loop_s: float, dt: float) -> Int:
    """Return (n,) an index into ``CAUSES`` plus a multiple of their number that separates successive corners.

    If several events are near, the more violent one explains the error.
    """
    before_s, after_s = BEFORE * loop_s, AFTER * loop_s
    cause = np.full(shape.speed.size, CAUSES.index("straight"), dtype=np.int64)
    cause[_mark_near(shape.arc, 0.0, RECENT * loop_s, dt)] = CAUSES.index("circular lag")
    for name in ("reversal", "stop", "start", "corner"):
        ahead_s = 0.0 if name == "corner" else before_s  # its rows begin with the smoothing
        near = _mark_near(shape.events[name], ahead_s, after_s, dt)
        cause[near] = CAUSES.index(name) + len(CAUSES) * _count_events(shape.events[name], ahead_s, dt)[near]
    cause[_mark_near(limited > 0.0, before_s, after_s, dt)] = CAUSES.index("saturation")
    return cause


def _revise_causes(
    cause: Int,
    runs: Sequence[tuple[int, int]],
    shape: PathGeometry,
    reference: Trajectory,
    contour_um: Float,
    loop_s: float,
    without_friction: Callable[[], Float] | None,
) -> None:
    """Revise each run's cause by its largest error: the nearest event may not be its cause."""
    names = [CAUSES[k % len(CAUSES)] for k in cause[[first for first, _ in runs]]]
    free = contour_um
    if without_friction is None:
        free = np.zeros(contour_um.size)
    elif {"reversal", "corner", "circular lag"} & set(names):
        free = without_friction()
    dt = reference.dt_s
    turned = _mark_near(shape.arc, 0.0, RECENT * loop_s, dt)
    recent = _mark_near(shape.events["corner"], BEFORE * loop_s, RECENT * loop_s, dt)
    reversing = _mark_near(shape.events["reversal"], BEFORE * loop_s, AFTER * loop_s, dt)
    across, along = shape.speed * shape.turn_rate, np.abs(np.gradient(shape.speed, dt))  # accelerations, mm/s2
    for (first, last), name in zip(runs, names, strict=True):
        peak = _find_peak(contour_um, first, last)
        frictions = free[peak] < MOST_OF_IT * contour_um[peak]
        led = slice(max(0, peak - round(BEFORE * loop_s / dt)), peak + 1)
        new = name
        if name in ("corner", "reversal", "circular lag") and frictions and reversing[peak]:
            new = "reversal"
        elif name == "reversal" and not frictions:
            new = "circular lag" if turned[peak] else name
        elif name == "corner":
            new = "circular lag" if shape.arc[peak] and not recent[peak] else name
        elif name in TO_REST and turned[peak] and across[led].max() > along[led].max():
            new = "circular lag"
        if new != name:
            cause[first:last] = CAUSES.index(new) + (len(CAUSES) * first if new == "reversal" else 0)


def _count_events(rows: Bool, before_s: float, dt: float) -> Int:
    """Return (n,) the number of the latest event; one begins ``before_s`` ahead of its first row."""
    first = np.flatnonzero(np.diff(rows.astype(np.int8), prepend=0) == 1)
    begins = np.zeros(rows.size, dtype=np.int64)
    np.add.at(begins, np.maximum(first - round(before_s / dt), 0), 1)
    return np.cumsum(begins)


def _mark_near(rows: Bool, before_s: float, after_s: float, dt: float) -> Bool:
    """Mark rows within ``before_s`` ahead of and ``after_s`` behind any of ``rows``."""
    before, after = round(before_s / dt), round(after_s / dt)
    marks = np.zeros(rows.size + 1, dtype=np.int64)
    events = np.flatnonzero(rows)
    np.add.at(marks, np.maximum(events - before, 0), 1)
    np.add.at(marks, np.minimum(events + after + 1, rows.size), -1)
    return np.asarray(np.cumsum(marks)[:-1] > 0)


def _find_spans(above: Bool, cause: Int, dt: float) -> list[tuple[int, int]]:
    """Return half-open runs of one cause above the threshold; gaps shorter than ``MERGE_S`` do not split them."""
    edges = np.flatnonzero(np.diff(np.where(_close_gaps(above, MERGE_S, dt), cause, -1), prepend=-2, append=-2) != 0)
    runs = []
    for first, last in pairwise(edges.tolist()):
        inside = np.flatnonzero(above[first:last])
        if inside.size >= max(1, round(SHORTEST_S / dt)):
            runs.append((int(first + inside[0]), int(first + inside[-1] + 1)))
    return runs


def _build_zone(reference: Trajectory, shape: PathGeometry, contour_um: Float, run: _ZoneSpan, loop_s: float) -> Zone:
    place = run.peak
    if run.cause == "corner":
        place = _find_sharpest_turn(shape, run.peak, loop_s, reference.dt_s)
    elif run.cause == "reversal":
        low = max(0, run.first - round(AFTER * loop_s / reference.dt_s))
        events = low + np.flatnonzero(shape.events["reversal"][low : run.last + 1])
        if events.size:
            place = int(events[np.argmin(np.abs(events - run.peak))])
    return Zone(
        start_s=round(float(reference.time_s[run.first]), 6),
        end_s=round(float(reference.time_s[run.last - 1]) + reference.dt_s, 6),
        where=reference.describe_position(place),
        max_um=float(contour_um[run.peak]),
        cause=run.cause,
    )
