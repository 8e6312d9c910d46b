"""Tracks the model of each axis: from the history at the start, then from the pipelines' outcomes."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from fdhil.identification import is_better_than_configured
from fdhil.records import LoopEstimate, Notice, Outcome, ParameterSet, Skill, Temperature
from fdhil.store import Revision
from fdhil.system_clock import SYSTEM_CLOCK, Clock

SKILL_MOVES = 3  # FAULTS E19: the last three recorded moves


@dataclass(frozen=True, slots=True)
class AxisModelState:
    """The model of an axis when it is armed: the newest published set with its age, the skills of the last moves.

    ``loops`` are the newest identified ones, if they explain what the configured ones do not.
    """

    published: ParameterSet | None
    age_s: float
    temperature_c: float | None
    skills: tuple[Skill, ...]
    load_changed: bool = False
    loops: LoopEstimate | None = None


@dataclass(slots=True)
class _TrackedAxis:
    published: ParameterSet | None = None
    published_s: float = 0.0
    temperature_c: float | None = None
    skills: deque[Skill] = field(default_factory=lambda: deque(maxlen=SKILL_MOVES))
    load_changed: bool = False
    loops: LoopEstimate | None = None


class ModelTracker:
    """Tracks the newest model of every axis."""

    def __init__(self, axes: Iterable[str], clock: Clock = SYSTEM_CLOCK) -> None:
        self._clock = clock
        self._axes = {axis: _TrackedAxis() for axis in axes}

    def start_from_history(self, newest: Mapping[str, Revision], skills: Sequence[Skill]) -> None:
        for name, revision in newest.items():
            axis = self._axes[name]
            axis.published, axis.published_s = (
                revision.set,
                self._read_clock_s() - revision.stamp.compute_age_s(self._clock),
            )
        self.take_outcomes(skills)

    def take_outcomes(self, outcomes: Sequence[Outcome | LoopEstimate]) -> None:
        for outcome in outcomes:
            if isinstance(outcome, ParameterSet):
                axis = self._axes[outcome.axis]
                axis.published, axis.published_s, axis.load_changed = outcome, self._read_clock_s(), False
            elif isinstance(outcome, Skill):
                self._axes[outcome.axis].skills.append(outcome)
            elif isinstance(outcome, LoopEstimate):
                self._axes[outcome.axis].loops = outcome if is_better_than_configured(outcome) else None
            elif isinstance(outcome, Notice) and outcome.code == "LoadChanged" and outcome.severity == "MAJOR":
                self._axes[outcome.axis].load_changed = True

    def take_temperature(self, reading: Temperature) -> None:
        self._axes[reading.axis].temperature_c = reading.celsius

    @property
    def temperatures(self) -> dict[str, float]:
        return {name: axis.temperature_c for name, axis in self._axes.items() if axis.temperature_c is not None}

    def _read_clock_s(self) -> float:
        return self._clock.read_boot_time_ns() * 1e-9

    def get_states(self) -> dict[str, AxisModelState]:
        now_s = self._read_clock_s()
        return {
            name: AxisModelState(
                axis.published,
                now_s - axis.published_s,
                axis.temperature_c,
                tuple(axis.skills),
                axis.load_changed,
                axis.loops,
            )
            for name, axis in self._axes.items()
        }
