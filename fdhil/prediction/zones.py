"""Zones: stretches of the path whose contour error stands out, where they are and why they are there."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fdhil.records import Bool, Float, Int, Trajectory, Zone

# an error stands out above this share of the largest one, and never below a micrometre
SHARE = 0.05
FLOOR_UM = 1.0
# an event explains the errors shortly before it (smoothing) and as long as the loops need to settle
BEFORE_S, AFTER_S = 0.05, 0.20
CORNER_S = 0.045  # a corner turns within twice this time; a turn that goes on is a circle
ASIDE_S = 0.07  # what lies further away than this is not the corner's own turn
SHARP = 0.6
CORNER_RAD = np.deg2rad(20.0)
BACK_RAD = np.deg2rad(179.0)  # in one row: the path goes back along its own line, which is a reversal
CHANGE = 1e-6  # of the largest speed, from one row to the next: less is none
PAUSE_S = 0.01  # a rest that is shorter is no stop
MERGE_S = 0.03
SHORTEST_S = 0.003

CAUSES = ("saturation", "corner", "start", "stop", "reversal", "circular lag", "straight")


@dataclass(frozen=True, slots=True)
class Geometry:
    """What the reference does, (n,) each: path speed in mm/s, turn rate in rad/s, and the rows of its events."""

    speed: Float
    turn_rate: Float
    events: dict[str, Bool]


def geometry(reference: Trajectory) -> Geometry:
    """Find starts, stops, corners and reversals of a reference."""
    dt = reference.dt_s
    path = np.column_stack([reference.position_mm[axis] for axis in reference.axes])
    velocity = np.zeros_like(path)
    velocity[:-1] = np.diff(path, axis=0) / dt
    speed = np.linalg.norm(velocity, axis=1)
    moving = speed > 1e-3 * max(float(speed.max()), 1e-9)
    # where an axis turns around it stands still for an instant: that is no stop
    going = moving | (_near(moving, PAUSE_S, 0.0, dt) & _near(moving, 0.0, PAUSE_S, dt))
    step = np.diff(going.astype(np.int8), prepend=0, append=0)
    start, stop = step[:-1] == 1, np.zeros(len(path), dtype=np.bool_)
    stop[np.clip(np.flatnonzero(step == -1), 0, len(path) - 1)] = True
    change = np.diff(speed, append=0.0)
    start |= _leading_to(start[::-1], change[::-1] > CHANGE * speed.max())[::-1]
    stop |= _leading_to(stop, change < -CHANGE * speed.max())
    turn_rate = _turn_rate(velocity, speed, moving, dt)
    return Geometry(
        speed,
        turn_rate,
        {
            "start": start,
            "stop": stop,
            "corner": _corners(turn_rate, dt),
            "reversal": np.any([_reversals(velocity[:, a]) for a in range(path.shape[1])], axis=0),
        },
    )


def _leading_to(events: Bool, changing: Bool) -> Bool:
    """Rows of the unbroken change of speed that leads to an event: an axis that brakes errs before it stops."""
    here = changing | events | np.roll(events, -1)
    run = np.cumsum(np.diff(here.astype(np.int8), prepend=0) == 1)  # the number of the last run that has begun
    last = np.zeros(int(run[-1]) + 1, dtype=np.int64)
    rows = np.flatnonzero(events)
    last[run[rows]] = rows  # the last event of a run is the last to be written
    return np.asarray(here & (np.arange(events.size) <= last[run]))


def _turn_rate(velocity: Float, speed: Float, moving: Bool, dt: float) -> Float:
    """Angle between successive directions of motion, per second; 0 at rest."""
    unit = velocity / np.maximum(speed, 1e-12)[:, None]
    chord = np.linalg.norm(np.diff(unit, axis=0), axis=1)
    angle = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    rate = np.zeros(len(speed))
    rate[:-1] = np.where(moving[:-1] & moving[1:], angle, 0.0) / dt
    return rate


def _corners(turn_rate: Float, dt: float) -> Bool:
    """Rows in the middle of a turn that is over within 2 ``CORNER_S``: more turns there than on both sides of it."""
    half, gap = max(1, round(CORNER_S / dt)), max(1, round(ASIDE_S / dt))
    turn_rate = np.where(turn_rate * dt > BACK_RAD, 0.0, turn_rate)
    total = np.concatenate([[0.0], np.cumsum(turn_rate) * dt])
    rows = np.arange(turn_rate.size)

    def turned(low: int, high: int) -> Float:
        first = np.clip(rows + low, 0, turn_rate.size)
        last = np.clip(rows + high, 0, turn_rate.size)
        return np.asarray(total[last] - total[first])

    here = turned(-half, half)
    aside = np.maximum(turned(-gap - 2 * half, -gap), turned(gap, gap + 2 * half))
    # a circle turns as much in the outer half of that time as in the inner one
    sharp = turned(-(half // 2), half // 2) > SHARP * here
    return np.asarray(_near((here > CORNER_RAD) & (here > 1.5 * aside) & sharp, CORNER_S, CORNER_S, dt))


def _reversals(velocity: Float) -> Bool:
    """Rows at which an axis changes its direction, whether or not it rests in between."""
    found = np.zeros(velocity.size, dtype=np.bool_)
    going = np.flatnonzero(np.abs(velocity) > 1e-6 * max(float(np.abs(velocity).max()), 1e-12))
    signs = np.sign(velocity[going])
    found[going[1:][signs[1:] != signs[:-1]]] = True
    return found


def find_zones(
    reference: Trajectory, contour_um: Float, limited: Float, above_um: float | None = None
) -> tuple[Zone, ...]:
    """Return the zones in the order of time; ``limited`` (n,) is the share of each cycle with a limit acting.

    ``above_um``: every error above it belongs to a zone; left out, what stands out against the largest.
    """
    above = contour_um > (max(FLOOR_UM, SHARE * float(contour_um.max())) if above_um is None else above_um)
    if not above.any():
        return ()
    shape = geometry(reference)
    cause = _causes(shape, limited, reference.dt_s)
    zones = [
        _zone(reference, shape, contour_um, first, last, CAUSES[cause[first] % len(CAUSES)])
        for first, last in _runs(above, cause, reference.dt_s)
    ]
    return tuple(zones)


def _causes(shape: Geometry, limited: Float, dt: float) -> Int:
    """Return (n,) an index into ``CAUSES`` plus a multiple of their number that parts one corner from the next.

    Where several events are near, the more violent one explains the error.
    """
    cause = np.full(shape.speed.size, CAUSES.index("straight"), dtype=np.int64)
    rate = np.where(shape.turn_rate * dt > BACK_RAD, 0.0, shape.turn_rate)
    turning = rate > 0.05 * max(float(rate.max()), 1e-9)
    cause[_near(turning, 0.0, 0.1, dt)] = CAUSES.index("circular lag")
    for name in ("reversal", "stop", "start", "corner"):
        near = _near(shape.events[name], BEFORE_S, AFTER_S, dt)
        cause[near] = CAUSES.index(name) + len(CAUSES) * _ordinal(shape.events[name], BEFORE_S, dt)[near]
    cause[_near(limited > 0.0, BEFORE_S, AFTER_S, dt)] = CAUSES.index("saturation")
    return cause


def _ordinal(rows: Bool, before_s: float, dt: float) -> Int:
    """Return (n,) the number of the latest event; one begins ``before_s`` ahead of its first row."""
    first = np.flatnonzero(np.diff(rows.astype(np.int8), prepend=0) == 1)
    begins = np.zeros(rows.size, dtype=np.int64)
    np.add.at(begins, np.maximum(first - round(before_s / dt), 0), 1)
    return np.cumsum(begins)


def _near(rows: Bool, before_s: float, after_s: float, dt: float) -> Bool:
    """Rows within ``before_s`` ahead of and ``after_s`` behind any of ``rows``."""
    before, after = round(before_s / dt), round(after_s / dt)
    marks = np.zeros(rows.size + 1, dtype=np.int64)
    events = np.flatnonzero(rows)
    np.add.at(marks, np.maximum(events - before, 0), 1)
    np.add.at(marks, np.minimum(events + after + 1, rows.size), -1)
    return np.asarray(np.cumsum(marks)[:-1] > 0)


def _runs(above: Bool, cause: Int, dt: float) -> list[tuple[int, int]]:
    """Half-open runs of one cause above the threshold; gaps shorter than ``MERGE_S`` do not part them."""
    closed = above | (_near(above, MERGE_S, 0.0, dt) & _near(above, 0.0, MERGE_S, dt))
    edges = np.flatnonzero(np.diff(np.where(closed, cause, -1), prepend=-2, append=-2) != 0)
    runs = []
    for first, last in pairwise(edges.tolist()):
        inside = np.flatnonzero(above[first:last])
        if inside.size >= max(1, round(SHORTEST_S / dt)):
            runs.append((int(first + inside[0]), int(first + inside[-1] + 1)))
    return runs


def _zone(reference: Trajectory, shape: Geometry, contour_um: Float, first: int, last: int, cause: str) -> Zone:
    peak = first + int(np.argmax(contour_um[first:last]))
    place = peak
    low = max(0, first - round(AFTER_S / reference.dt_s))
    if cause == "corner":
        place = low + int(np.argmax(shape.turn_rate[low:last]))
    elif cause == "reversal":
        events = low + np.flatnonzero(shape.events["reversal"][low : last + 1])
        if events.size:
            place = int(events[np.argmin(np.abs(events - peak))])
    where = " ".join(f"{axis} {reference.position_mm[axis][place]:.1f}" for axis in reference.axes)
    return Zone(
        start_s=round(float(reference.time_s[first]), 6),
        end_s=round(float(reference.time_s[last - 1]) + reference.dt_s, 6),
        where=where,
        max_um=float(contour_um[peak]),
        cause=cause,
    )
