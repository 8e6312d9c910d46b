"""Tracks the parameters from rapid to rapid: holds back jumps, reports a changed load, raises maintenance alarms.

Friction, which includes a constant load, is compared per direction. Pure: without a clock.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fdhil.config import Maintenance
from fdhil.records import PARAMETERS, UNITS, Float, Notice, Parameters

HISTORY = 32
RECENT = 8
LEAST_HISTORY = 3
BEYOND_CHANCE = 5.0
HELD_EPISODES = 2
AGREEING = 2
SURELY = 2.0  # standard deviations by which a change must exceed its limit
RELEASE = 0.8  # an alarm is cleared when the change has fallen to this share of its limit
RELEASING = 4  # estimates whose mean clears an alarm
FRICTION_PARAMETERS = ("ft", "Cd")
# smaller changes are drift, not a jump, however narrow the intervals are
LEAST_JUMP: Mapping[str, float] = {"R": 0.05, "L": 0.08, "K": 0.03, "Jt": 0.03, "ft": 0.40, "Cd": 0.25}


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """One estimate in the history."""

    values: Float
    stds: Float
    tick: int
    direction: int = 1


@dataclass(slots=True)
class DriftTracker:
    """The parameter history of one axis; turns each validated window or pool into notices for the operator."""

    maintenance: Maintenance
    axis: str = ""
    points: deque[DriftPoint] = field(default_factory=lambda: deque(maxlen=HISTORY))
    references: dict[int, Parameters] = field(default_factory=dict)
    alarms: set[str] = field(default_factory=set)
    _held: list[DriftPoint] = field(default_factory=list)

    def update(self, values: Parameters, covariance: Float, tick: int = 0, direction: int = 1) -> list[Notice]:
        """Add a validated estimate of a move in one ``direction`` with its covariance; return the notices.

        ``ParameterJump`` holds the estimate back for ``HELD_EPISODES`` further ones. A step of Jt alone is
        ``LoadChanged``: the correction must be withdrawn at once, and the new Jt is used after the second estimate that
        agrees.
        """
        stds = np.sqrt(np.clip(np.diag(covariance)[: len(PARAMETERS)], 0.0, None))
        point = DriftPoint(np.array(list(values.as_dict().values())), stds, tick, direction)
        self.references.setdefault(direction, values)
        moved = self._find_jumps(point)
        if not moved:
            self._held.clear()
            self.points.append(point)
            return self._update_alarms(point)
        return self._hold_back(point, moved)

    def resume(self, first: Mapping[int, Parameters], points: Iterable[DriftPoint]) -> None:
        """Continue after a restart without repeating alarms that the stored ``points`` had raised.

        ``first`` are the first values of either direction, the reference for changes.
        """
        self.references = dict(first)
        for point in points:
            self.points.append(point)
            if point.direction in self.references:
                self._update_alarms(point)

    @property
    def is_holding_back(self) -> bool:
        """Whether the newest estimate is held back and must not be used yet."""
        return bool(self._held)

    def _select_recent(self, direction: int) -> list[list[DriftPoint]]:
        points = list(self.points)
        same = [point for point in points if point.direction == direction][-RECENT:]
        return [same if name in FRICTION_PARAMETERS else points[-RECENT:] for name in PARAMETERS]

    def _find_jumps(self, point: DriftPoint) -> list[str]:
        """Return the parameters that differ from the recent history by more than chance and drift (median and MAD)."""
        moved = []
        for k, (name, recent) in enumerate(zip(PARAMETERS, self._select_recent(point.direction), strict=True)):
            if len(recent) < LEAST_HISTORY:
                continue
            values = np.array([p.values[k] for p in recent])
            middle = float(np.median(values))
            scatter = 1.4826 * np.median(np.abs(values - middle))
            spread = np.median([p.stds[k] for p in recent])
            chance = BEYOND_CHANCE * np.sqrt(scatter**2 + point.stds[k] ** 2 + spread**2)
            if abs(point.values[k] - middle) > max(chance, LEAST_JUMP[name] * abs(middle)):
                moved.append(name)
        return moved

    def _hold_back(self, point: DriftPoint, moved: Sequence[str]) -> list[Notice]:
        before = [np.median([p.values[k] for p in at]) for k, at in enumerate(self._select_recent(point.direction))]
        self._held = [p for p in self._held if self._is_consistent(p, point)]
        self._held.append(point)
        load = list(moved) == ["Jt"]
        needed = AGREEING if load else HELD_EPISODES + 1
        settled = len(self._held) >= needed
        code = "LoadChanged" if load else "ParameterJump"
        what = ", ".join(
            f"{n} {before[k]:.4g} -> {point.values[k]:.4g} {UNITS[n]}" for k, n in enumerate(PARAMETERS) if n in moved
        )
        if settled:
            held, self._held = self._held, []
            self.points.clear()
            self.points.extend(held)
            text = f"{what}: {needed} estimates agree, so the new value is used"
            return [Notice(code, "minor", text, self.axis, point.tick), *self._update_alarms(point)]
        left = needed - len(self._held)
        text = f"{what}: held back until {left} further estimate{'s agree' if left > 1 else ' agrees'}"
        return [Notice(code, "MAJOR" if load else "minor", text, self.axis, point.tick)]

    @staticmethod
    def _is_consistent(one: DriftPoint, other: DriftPoint) -> bool:
        same_direction = one.direction == other.direction
        rows = [k for k, name in enumerate(PARAMETERS) if same_direction or name not in FRICTION_PARAMETERS]
        chance = BEYOND_CHANCE * np.sqrt(one.stds**2 + other.stds**2)
        least = np.array([LEAST_JUMP[name] for name in PARAMETERS]) * np.abs(one.values)
        return bool((np.abs(one.values - other.values) <= np.maximum(chance, least))[rows].all())

    def _update_alarms(self, point: DriftPoint) -> list[Notice]:
        """Return maintenance alarms that begin or end: relative change from the first value, with hysteresis.

        One significant window raises an alarm; it is cleared when the mean of the newest is significantly below
        ``RELEASE``.
        """
        notices = []
        for k, (name, first) in enumerate(self.references[point.direction].as_dict().items()):
            if not (first and np.isfinite(point.values[k])):
                continue
            limit = float(getattr(self.maintenance, name))
            change, doubt = abs(point.values[k] - first) / abs(first), SURELY * point.stds[k] / abs(first)
            if name not in self.alarms and change - doubt > limit:
                self.alarms.add(name)
                moved = f"{name} has changed by {100 * change:.0f} % to {point.values[k]:.4g} {UNITS[name]}"
                text = f"{moved}, limit {100 * limit:.0f} %"
                notices.append(Notice("MaintenanceDue", "minor", text, self.axis, point.tick))
            elif name in self.alarms and self._is_released(k, limit):
                self.alarms.discard(name)
                text = f"{name} is back at {point.values[k]:.4g} {UNITS[name]}"
                notices.append(Notice("MaintenanceDue", "info", text, self.axis, point.tick))
        return notices

    def _is_released(self, k: int, limit: float) -> bool:
        newest = [p for p in list(self.points)[-RELEASING:] if np.isfinite(p.values[k]) and np.isfinite(p.stds[k])]
        firsts = [list(self.references[p.direction].as_dict().values())[k] for p in newest if self._has_reference(p, k)]
        if not firsts or len(firsts) < len(newest):
            return False
        shares = np.array([p.values[k] / first for p, first in zip(newest, firsts, strict=True)])
        doubts = np.array([p.stds[k] / first for p, first in zip(newest, firsts, strict=True)])
        doubt = SURELY * float(np.sqrt(np.mean(doubts**2) / len(newest)))
        return abs(float(np.mean(shares)) - 1) + doubt < RELEASE * limit

    def _has_reference(self, point: DriftPoint, k: int) -> bool:
        first = self.references.get(point.direction)
        return first is not None and bool(list(first.as_dict().values())[k])
