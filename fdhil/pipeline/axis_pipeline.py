"""Processes the samples of one axis: extracts windows, analyses, tracks drift, pools, publishes, assesses the model.

:class:`AxisPipeline` keeps the recent samples, extracts a window of each completed rapid, has it analysed, holds back
windows with a parameter jump, pools the accepted ones, publishes a parameter set when the pool is validated, and
compares the closed-loop model with every recorded move. A replayed window is processed alike (``feed(window)``).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from fdhil.config import MachineConfig
from fdhil.identification import (
    HISTORY_WINDOWS,
    LEAST_JUMP,
    DriftPoint,
    DriftTracker,
    PoolMember,
    build_pool_member,
    compute_change_covariance,
    find_windows,
)
from fdhil.pipeline.identified_loops import LoopTracker
from fdhil.pipeline.sample_buffer import SampleBuffer
from fdhil.pipeline.validated_pool import check_both_directions, estimate_together, is_model_refused
from fdhil.prediction import assess_model_skill
from fdhil.records import (
    AxisSamples,
    Estimate,
    LoopEstimate,
    MoveEvent,
    MoveKind,
    NcMove,
    Notice,
    Outcome,
    Parameters,
    ParameterSet,
    Skill,
    TableSamples,
    Temperature,
    TickTimes,
    Verdict,
    VoltageSamples,
    Window,
    WindowOutcome,
)
from fdhil.validation import detect_gain_error

RECENT_S = 30.0  # longer rapids are truncated, and then refused for a missing stage
LEAD_S = 0.25  # standstill before a rapid
SETTLE_S = 0.30  # after the demand has ended: the shaft comes to rest, and stays there for the window's margin
VOLTAGE_PATIENCE_S = 1.0  # how much later than the drive's samples a separate sensor may deliver
WAITING_RAPIDS = 300  # one each 0.1 s; the samples of older ones are dropped before a voltage could arrive
POOL_WINDOWS = 4  # both directions twice: enough to separate viscous from dry friction, few enough to follow drift

JUMPS = {"LoadChanged", "ParameterJump"}

Record = AxisSamples | VoltageSamples | TableSamples | TickTimes | MoveEvent | Temperature | Window


@dataclass(frozen=True, slots=True)
class _Rapid:
    """A rapid move that the NC ordered: from ``start`` to ``end`` (None while it lasts)."""

    start: int
    end: int | None
    source: str
    nc: NcMove | None = None


@dataclass(frozen=True, slots=True)
class PipelineState:
    """The history of an axis: the first values in either direction, the newest published set, and more.

    ``points`` and ``members`` are the newest accepted windows' estimates, for the tracker and for the pool; ``loops``
    are the newest identified loops.
    """

    first: Mapping[int, Parameters] = field(default_factory=dict)
    newest: ParameterSet | None = None
    points: tuple[DriftPoint, ...] = ()
    members: tuple[PoolMember, ...] = ()
    loops: LoopEstimate | None = None


@dataclass(frozen=True, slots=True)
class _PooledWindow:
    outcome: WindowOutcome
    member: PoolMember


def select_newest(found: Sequence[_PooledWindow]) -> list[_PooledWindow]:
    """Return the newest windows, and as many older ones as give each direction two, where possible."""
    kept = set(range(max(0, len(found) - POOL_WINDOWS), len(found)))
    for direction in (1, -1):
        its = [k for k, each in enumerate(found) if each.outcome.window.direction == direction]
        kept.update(its[-POOL_WINDOWS // 2 :])
    return [found[k] for k in sorted(kept)]


class AxisPipeline:
    """The state of one axis, and the outcomes of its next record."""

    def __init__(
        self,
        axis: str,
        config: MachineConfig,
        method: str | None = None,
        known: PipelineState | None = None,
        with_skill: bool = True,
    ) -> None:
        """Start with the estimator ``method`` (None: the configured one), from the state ``known`` of an earlier run.

        ``with_skill`` False omits what needs the axis' own section, for a recording of which none is known.
        """
        self.axis = axis
        self._config = config
        self._settings = config.identification
        if method is not None:
            self._settings = config.identification.model_copy(update={"method": method})
        self._period_s = config.machine.sync_period_s
        known = known or PipelineState()
        self._recent = SampleBuffer(axis, config.axis[axis], self._convert_to_ticks(RECENT_S), self._period_s)
        self._rapids: deque[_Rapid] = deque(maxlen=WAITING_RAPIDS)
        self._temperature: Temperature | None = None
        self._pool: list[_PooledWindow] = []
        self._held: list[_PooledWindow] = []
        self._refused: dict[int, WindowOutcome] = {}  # the newest window of a direction, where its model was refused
        self._published = known.newest
        self._tracker = DriftTracker(config.maintenance, axis)
        self._tracker.resume(known.first, known.points)
        self._history: deque[PoolMember] = deque(_select_since_jump(known), maxlen=HISTORY_WINDOWS)
        self._with_skill = with_skill
        # without it the axis' section is invented
        self._loops = LoopTracker(
            config.axis[axis] if with_skill else None, self._settings, self._period_s, known.loops
        )
        self._gain_suspected = False
        self._place = self._history[-1].place if self._history else 0
        self._withheld: tuple[str, ...] = ()  # why the newest pool was not published: reported once

    @property
    def published(self) -> ParameterSet | None:
        """The newest published parameter set."""
        return self._published

    def _convert_to_ticks(self, seconds: float) -> int:
        return round(seconds / self._period_s)

    def process_record(self, record: Record) -> list[Outcome]:
        """Process one record and return its outcomes; a record of another axis is ignored."""
        if isinstance(record, TickTimes):
            self._recent.append_block(record)
            return self._analyse_completed_rapids()
        if record.axis != self.axis:
            return []
        if isinstance(record, Window):
            return self._analyse_window(record)
        if isinstance(record, MoveEvent):
            self._record_move(record)
        elif isinstance(record, Temperature):
            self._temperature = record
        else:
            if isinstance(record, AxisSamples) and record.tick.size:
                self._detect_sync_restart(record)
            self._recent.append_block(record)
        return self._analyse_completed_rapids()

    def _detect_sync_restart(self, samples: AxisSamples) -> None:
        newest = self._recent.newest_tick
        if newest is not None and samples.tick[0] <= newest:  # the SYNC count was restarted
            self._recent.clear()
            self._rapids.clear()

    def _record_move(self, event: MoveEvent) -> None:
        if self._rapids and self._rapids[-1].end is None:
            self._rapids[-1] = replace(self._rapids[-1], end=event.tick)
        if event.kind is MoveKind.RAPID:
            self._rapids.append(_Rapid(event.tick, None, event.source, event.nc))

    def _analyse_completed_rapids(self) -> list[Outcome]:
        outcomes: list[Outcome] = []
        while self._rapids and self._is_complete(self._rapids[0]):
            for window in self._extract_windows(self._rapids.popleft()):
                outcomes += self._analyse_window(window)
        return outcomes

    def _is_complete(self, rapid: _Rapid) -> bool:
        newest = self._recent.newest_tick
        if newest is None:
            return False
        if rapid.end is None:
            return newest - rapid.start > self._convert_to_ticks(RECENT_S)
        last = rapid.end + self._convert_to_ticks(SETTLE_S)
        if newest < last:
            return False
        patient = newest < last + self._convert_to_ticks(VOLTAGE_PATIENCE_S)
        return not (self._recent.separate_voltage and patient and not self._recent.has_voltage_until(last))

    def _extract_windows(self, rapid: _Rapid) -> list[Window]:
        """Return the window of a completed rapid; none if the shaft never came near the rapid speed."""
        newest = self._recent.newest_tick
        assert newest is not None
        end = newest if rapid.end is None else rapid.end
        start = max(rapid.start - self._convert_to_ticks(LEAD_S), newest - self._convert_to_ticks(RECENT_S))
        recording = replace(
            self._recent.extract_recording(start, min(newest, end + self._convert_to_ticks(SETTLE_S)) + 1),
            temperature_c=None if self._temperature is None else self._temperature.celsius,
            source=rapid.source,
        )
        # neighbouring rapids may reach into the recording; they have windows of their own
        windows = [w for w in find_windows(recording) if rapid.start <= w.start_tick + w.n // 2 <= end]
        return [replace(w, nc=rapid.nc) for w in windows]

    def _analyse_window(self, window: Window) -> list[Outcome]:
        outcome, loops = self._loops.analyse_rapid(window)
        before = self._published
        outcomes: list[Outcome] = [outcome] if loops is None else [outcome, loops]
        if is_model_refused(outcome):
            self._refused[window.direction] = outcome
        # a correction needs all six: with undetermined values the previous set stays in use
        if outcome.verdict.accepted and outcome.estimate is not None and not outcome.estimate.missing:
            self._refused.pop(window.direction, None)
            notices = self._track_drift(outcome, outcome.estimate)
            outcomes += notices
            if not self._tracker.is_holding_back:
                outcomes += self._publish_parameters(window)
        judged = self._assess_skill(window, before or self._published)
        return [*outcomes, judged] if judged else outcomes

    def _track_drift(self, outcome: WindowOutcome, estimate: Estimate) -> list[Notice]:
        """Hold back a window with a parameter jump; once further ones agree with it they are the new pool."""
        window = outcome.window
        self._place += 1
        found = _PooledWindow(outcome, build_pool_member(window, estimate, self._place))
        covariance = compute_change_covariance(window, estimate)
        notices = self._tracker.update(estimate.build_parameters(), covariance, window.start_tick, window.direction)
        if self._tracker.is_holding_back:
            self._held.append(found)
            return notices
        if any(notice.code in JUMPS for notice in notices):
            agreeing = {point.tick for point in self._tracker.points}
            self._pool = [held for held in self._held if held.outcome.window.start_tick in agreeing]
            self._history.clear()
            self._history.extend(held.member for held in self._pool)
        self._held.clear()
        self._pool = select_newest([*self._pool, found])
        self._history.append(found.member)
        return notices

    def _publish_parameters(self, window: Window) -> list[Outcome]:
        """Publish the pool's estimate; windows that no longer agree with the newest leave it, the oldest first."""
        estimate, verdict = self._pool_windows()
        while not verdict.accepted and len(self._pool) > 1 and not check_both_directions(self._collect_outcomes()):
            self._pool.pop(0)
            while self._history[0].place < self._pool[0].member.place:
                self._history.popleft()
            estimate, verdict = self._pool_windows()
        if estimate is None or not verdict.accepted:
            why = "; ".join(str(reason) for reason in verdict.reasons)
            text = f"the newest pool is not accepted ({why}), the previous set stays in use"
            codes = tuple(reason.code for reason in verdict.reasons)
            again, self._withheld = self._withheld == codes, codes
            return [] if again else [Notice("ValidationFailed", "minor", text, self.axis, window.start_tick)]
        self._withheld = ()
        self._published = ParameterSet(
            axis=self.axis,
            revision=1 if self._published is None else self._published.revision + 1,
            parameters=estimate.build_parameters(),
            covariance=estimate.covariance,
            windows=len(self._pool),
            tick=window.start_tick + window.n,
            temperature_c=window.temperature_c,
            config_digest=self._config.digest,
            window_ticks=tuple(found.outcome.window.start_tick for found in self._pool),
            unexplained_um=verdict.unexplained_um,
            warnings=verdict.warnings,
            loops=self._loops.changed_regulators,
        )
        return [self._published, *self._compare_with_data_sheet(estimate, window.start_tick)]

    def _collect_outcomes(self) -> list[WindowOutcome]:
        """Return the windows that decide on the pool: its own, and one of a direction whose moves are refused."""
        return [*(found.outcome for found in self._pool), *self._refused.values()]

    def _pool_windows(self) -> tuple[Estimate | None, Verdict]:
        members = [found.member for found in self._pool]
        return estimate_together(self._collect_outcomes(), members, tuple(self._history), self._settings)

    def _compare_with_data_sheet(self, estimate: Estimate, tick: int) -> list[Notice]:
        """Report, when it first appears, that only a sensor's gain explains the offset from the nominal values."""
        if not self._with_skill:  # the axis' section is invented
            return []
        nominal = Parameters(**self._config.axis[self.axis].nominal.model_dump())
        reason, before = detect_gain_error(estimate, nominal), self._gain_suspected
        self._gain_suspected = reason is not None
        if reason is None or before:
            return []
        return [Notice(reason.code, "minor", f"{reason.text}; {reason.advice}", self.axis, tick)]

    def _assess_skill(self, window: Window, published: ParameterSet | None) -> Skill | None:
        if published is None or not self._with_skill:
            return None
        axis = self._loops.axis or self._config.axis[self.axis]
        return assess_model_skill(window, published.parameters, axis, self._period_s)


def _select_since_jump(known: PipelineState) -> Sequence[PoolMember]:
    """Return the newest windows after the last one that does not agree with the newest published set."""
    if known.newest is None:
        return known.members
    now = known.newest.parameters.as_dict()
    for k, each in reversed(list(enumerate(known.members))):
        values = dict(zip(each.names, each.values.tolist(), strict=True))
        if any(abs(values[n] - now[n]) > LEAST_JUMP[n] * abs(now[n]) for n in ("R", "L", "K", "Jt") if n in values):
            return known.members[k + 1 :]
    return known.members
