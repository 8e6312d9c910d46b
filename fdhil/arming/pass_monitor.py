"""Measures the contour error that remains in each pass of a corrected program, from the drives' own feedback.

The NC's targets are compared with the drives' positions as in a prediction, from the first motion after arming to the
program's end. Samples are taken in the event loop; everything else is done by ``digest``, in a thread.
"""

from __future__ import annotations

import math
import sys
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdhil.arming.iterative_learning import IterativeLearner
from fdhil.config import MachineConfig
from fdhil.correction import LEAST_GAIN, LearnedOffset
from fdhil.errors import StoreError
from fdhil.prediction import WINDOW_S, compute_contour_error_um, format_upper_limit
from fdhil.records import AxisSamples, Float, Int, MoveKind, NcState, Notice, Parameters, Reason, compute_table_path
from fdhil.system_clock import SYSTEM_CLOCK, Clock

Rows = tuple[Int, Float, Float]
"""Tick, demand and position (n,) of an axis."""
KEPT = 20
CHUNK_S = 2.0  # compared at once
LATE_S = 0.5  # by which samples may arrive after the guard's status
MOST_BLOCKS = 1000
MOST_LEAD_S = 10.0
TOLERANCE_INCREMENTS = 2.5
WORSE = 1.05  # times the error predicted without a correction
SHOWN_CURVE = 8  # passes
FULL_OVERRIDE = 0.005  # tolerance of an override of 100 %
FINISHED = "Finished"  # the guard's cause of a program that ran to its end


class _EndedPass(NamedTuple):
    """A pass that the guard has ended; its last samples may arrive until ``due_s``."""

    running: ProgramPass
    models: Mapping[str, Parameters]
    due_s: float
    cause: str
    summary: Mapping[str, Any]
    late: str


class PassMonitor:
    """Monitors the running pass and keeps the measurements of the last ones."""

    def __init__(self, config: MachineConfig, clock: Clock = SYSTEM_CLOCK) -> None:
        self._config, self._clock = config, clock
        self._count = Counter[str]()
        self._running: ProgramPass | None = None
        self._models: Mapping[str, Parameters] = {}
        self._broken: dict[str, tuple[Mapping[str, Parameters], Reason]] = {}
        self._ended: deque[_EndedPass] = deque()
        self._taken: deque[AxisSamples] = deque()
        self.reports: deque[Mapping[str, Any]] = deque(maxlen=KEPT)

    def start_pass(
        self,
        demand: Mapping[str, Sequence[int]],
        rows: int | None,
        models: Mapping[str, Parameters],
        learner: IterativeLearner | None = None,
        ahead_mm: Float | None = None,
    ) -> None:
        """Start a pass, before a program is armed: its first table rows in increments, the row count, its learner.

        ``ahead_mm`` (n, axes) is the table position less the encoder position, if it is known.
        """
        self._running = ProgramPass(self._config, demand, rows, learner, ahead_mm)
        self._models = models

    def find_broken_prediction(self, program_digest: str, models: Mapping[str, Parameters]) -> Reason | None:
        """Return why a program is not corrected again by the same models: its last pass was worse than predicted."""
        found = self._broken.get(program_digest)
        return None if found is None or found[0] != models else found[1]

    def cancel_pass(self) -> None:
        self._running = None

    def take_samples(self, samples: AxisSamples) -> None:
        if self._running is not None or self._ended:
            self._taken.append(samples)

    def take_nc_state(self, state: NcState) -> None:
        if self._running is not None:
            self._running.take_nc_state(state)

    def end_pass(self, cause: str, summary: Mapping[str, Any], late: str = "") -> None:
        """End the pass with the correction; ``late`` says how late this computer was if that was the cause."""
        if self._running is not None:
            due_s = self._clock.now_s() + LATE_S
            self._ended.append(_EndedPass(self._running, self._models, due_s, cause, summary, late))
            self._running = None

    def process_samples(self) -> list[Notice]:
        """Process the samples taken so far (in a thread); return notices of the passes that have ended."""
        monitored = [each.running for each in tuple(self._ended)]
        if self._running is not None:
            monitored.append(self._running)
        while self._taken:
            samples = self._taken.popleft()
            for each in monitored:
                each.take_samples(samples)
        notices = []
        while self._ended and self._clock.now_s() >= self._ended[0].due_s:
            ended = self._ended.popleft()
            measured = ended.running.measure_errors()
            notices += [] if measured is None else self._report_pass(ended, measured)
        return notices

    def _report_pass(self, ended: _EndedPass, measured: Mapping[str, Any]) -> list[Notice]:
        summary = ended.summary
        digest = str(summary["program_digest"])
        self._count[digest] += 1
        report: dict[str, Any] = {
            "program": summary["program"],
            "program_digest": digest,
            "pass": self._count[digest],
            "ended_by": ended.cause,
            "late": ended.late,
            **measured,
            "predicted": {key: summary["after"].get(key) for key in ("rms_um", "uncertainty_um")},
            "predicted_without": {"rms_um": summary["before"]["rms_um"]},
            "gain": _compute_gains(summary, measured),
        }
        learned_offsets, notices = _learn_from_ended_pass(ended)
        text = _format_report(report) + ("" if learned_offsets is None else _format_learning(learned_offsets))
        if ended.running.disturbed is not None:
            report["disturbed"] = ended.running.disturbed
            text += f"; {ended.running.disturbed}: the pass is not used for learning"
        learned = (
            {}
            if learned_offsets is None
            else {"learned": {"passes": len(learned_offsets.curve_um), "curve_um": learned_offsets.curve_um}}
        )
        self.reports.append({**report, "text": text, **learned})
        self._check_prediction(ended, report, text)
        return [_make_notice(report, text), *notices]

    def _check_prediction(self, ended: _EndedPass, report: Mapping[str, Any], text: str) -> None:
        digest = report["program_digest"]
        self._broken.pop(digest, None)
        if (
            ended.cause == FINISHED
            and ended.running.disturbed is None
            and report["measured"]["rms_um"] * LEAST_GAIN > report["predicted_without"]["rms_um"]
        ):
            advice = "run a few rapids to identify the machine again, then arm"
            reason = Reason("PromiseBroken", f"{text}: the correction was withdrawn", advice)
            self._broken[digest] = (ended.models, reason)


class ProgramPass:
    """One pass: the rows of all axes of the table, joined by tick; ``rows`` None: up to the program's end."""

    def __init__(
        self,
        config: MachineConfig,
        demand: Mapping[str, Sequence[int]],
        rows: int | None,
        learner: IterativeLearner | None = None,
        ahead_mm: Float | None = None,
    ) -> None:
        self._learner = learner
        self._ahead_mm = ahead_mm
        self._learned_rows: list[tuple[Float, Float]] = []
        self._left = rows if rows is not None else sys.maxsize
        self._axes = tuple(demand)
        self._dt_s = config.machine.sync_period_s
        self._margin = round(WINDOW_S / self._dt_s)
        scales = [config.axis[a].scaling.sign * config.axis[a].scaling.increments_per_mm for a in self._axes]
        path = np.column_stack([np.asarray(demand[a], dtype=np.float64) for a in self._axes]) / scales
        self._tolerance_mm = TOLERANCE_INCREMENTS / np.abs(scales)
        self._start_mm: Float = path[0]
        leaves = np.flatnonzero(self._has_left_start(path))
        self._lead = min(int(leaves[0]) if leaves.size else 0, round(MOST_LEAD_S / self._dt_s))
        self._waiting: dict[str, list[Rows]] = {axis: [] for axis in self._axes}
        self._demand: Float = np.empty((0, len(self._axes)))
        self._position: Float = np.empty((0, len(self._axes)))
        self._first = 0  # first row of the buffer that was not compared yet
        self._begun = self._at_start = False
        self._rows, self._squares, self._max_um = 0, 0.0, 0.0
        self._following = np.zeros(len(self._axes))
        self.disturbed: str | None = None

    def _has_left_start(self, rows_mm: Float) -> Any:
        return np.any(np.abs(rows_mm - self._start_mm) > self._tolerance_mm, axis=1)

    def take_nc_state(self, state: NcState) -> None:
        """Note the first event by which the pass was no longer as planned."""
        if self.disturbed is None:
            self.disturbed = find_disturbance(state)

    def take_samples(self, samples: AxisSamples) -> None:
        """Take a block of one axis; rows that all axes have by then are processed."""
        if samples.axis not in self._waiting or samples.tick.size == 0:
            return
        self._waiting[samples.axis].append((samples.tick, samples.demand_mm, samples.position_mm))
        if not all(self._waiting.values()):
            if len(self._waiting[samples.axis]) > MOST_BLOCKS:  # no samples of another axis arrive
                self._waiting[samples.axis].clear()
            return
        blocks = {axis: _join_blocks(waiting) for axis, waiting in self._waiting.items()}
        self._waiting = {axis: [] for axis in self._axes}
        if any(np.any(np.diff(tick) <= 0) for tick, _, _ in blocks.values()):  # the SYNC count restarted
            return
        last = min(int(tick[-1]) for tick, _, _ in blocks.values())
        for axis, (tick, demand, position) in blocks.items():
            if (later := tick > last).any():
                self._waiting[axis].append((tick[later], demand[later], position[later]))
        self._add_rows(
            *_select_common_ticks([(t[t <= last], d[t <= last], p[t <= last]) for t, d, p in blocks.values()])
        )

    def _add_rows(self, demand: Float, position: Float) -> None:
        left = None if self._begun else self._find_departure(demand)
        self._demand = np.concatenate([self._demand, demand])
        self._position = np.concatenate([self._position, position])
        if left is not None:
            self._begun = True
            self._first = max(0, len(self._demand) - len(demand) + left - self._lead)
        if not self._begun:
            keep = self._lead + 2 * self._margin
            self._demand, self._position = self._demand[-keep:], self._position[-keep:]
            return
        while len(self._demand) >= self._first + self._margin + round(CHUNK_S / self._dt_s):
            self._add_errors(len(self._demand) - self._margin)

    def _find_departure(self, demand: Float) -> int | None:
        """Return the row in which the demand leaves the program's start after standing there; None until it does."""
        away = self._has_left_start(demand)
        stood = np.concatenate([[self._at_start], ~away[:-1]])
        leaves = np.flatnonzero(away & stood)
        self._at_start = not away[-1] if away.size else self._at_start
        return int(leaves[0]) if leaves.size else None

    def _add_errors(self, end: int) -> None:
        end = max(self._first, min(end, self._first + self._left))
        if end > self._first:
            position = self._position[self._first : end]
            if self._ahead_mm is not None:
                position = position + self._ahead_mm[self._rows : self._rows + len(position)]
            path, table = compute_table_path(self._axes, self._demand), compute_table_path(self._axes, position)
            error = compute_contour_error_um(path, table, self._dt_s, self._first)
            self._rows, self._left = self._rows + error.size, self._left - error.size
            self._squares += float(error @ error)
            self._max_um = max(self._max_um, float(error.max()))
            self._following += np.sum((position - self._demand[self._first : end]) ** 2, axis=0) * 1e6
            if self._learner is not None:
                self._learned_rows.append((self._demand[self._first : end].copy(), position.copy()))
        drop = max(0, end - self._margin) if self._left else len(self._demand)
        self._demand, self._position, self._first = self._demand[drop:], self._position[drop:], max(0, end - drop)

    def measure_errors(self) -> Mapping[str, Any] | None:
        """Return what was measured so far; None if the program has not begun."""
        if self._begun:
            self._add_errors(len(self._demand))
        if not self._rows:
            return None
        following = np.sqrt(self._following / self._rows)
        return {
            "rows": self._rows,
            "measured": {"rms_um": math.sqrt(self._squares / self._rows), "max_um": self._max_um},
            "following_rms_um": dict(zip(self._axes, following.tolist(), strict=True)),
        }

    def learn_from_pass(self) -> LearnedOffset | None:
        """Return what was learned from the completed pass; None without a learner, or if it was not as planned."""
        if self._learner is None or not self._learned_rows:
            return None
        demand, position = (np.concatenate([rows[k] for rows in self._learned_rows]) for k in range(2))
        return self._learner.learn_from_pass(demand, position)


def find_disturbance(state: NcState) -> str | None:
    """Return the NC's event by which a running program is not as planned (feed hold, override); None without one."""
    where = "" if state.line is None else f" in line {state.line}"
    if state.is_held:
        return f"the NC held its feed{where}"
    override = state.rapid_override if state.motion is MoveKind.RAPID else state.feed_override
    moving = state.motion in (MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC)
    if moving and override is not None and abs(override - 1.0) > FULL_OVERRIDE:
        return f"the NC's override was {100 * override:.0f} %{where}"
    return None


def _learn_from_ended_pass(ended: _EndedPass) -> tuple[LearnedOffset | None, list[Notice]]:
    if ended.cause != FINISHED or ended.running.disturbed is not None:
        return None, []
    try:
        return ended.running.learn_from_pass(), []
    except StoreError as error:
        return None, [Notice(error.code or "StoreFault", "minor", f"what was learned from the pass is lost: {error}")]


def _join_blocks(blocks: Sequence[Rows]) -> Rows:
    tick, demand, position = (np.concatenate([block[k] for block in blocks]) for k in range(3))
    return tick, demand, position


def _select_common_ticks(axes: Sequence[Rows]) -> tuple[Float, Float]:
    """Return demand and position (n, axes) of the ticks that all axes have, complete rows only."""
    ticks = axes[0][0]
    for tick, _, _ in axes[1:]:
        ticks = np.intersect1d(ticks, tick, assume_unique=True)
    rows = [np.searchsorted(tick, ticks) for tick, _, _ in axes]
    demand = np.column_stack([axis[1][at] for axis, at in zip(axes, rows, strict=True)])
    position = np.column_stack([axis[2][at] for axis, at in zip(axes, rows, strict=True)])
    whole = np.isfinite(demand).all(axis=1) & np.isfinite(position).all(axis=1)
    return demand[whole], position[whole]


def _compute_gains(summary: Mapping[str, Any], measured: Mapping[str, Any]) -> dict[str, float | None]:
    without_um, left = summary["before"]["rms_um"], {"predicted": summary["after"], "measured": measured["measured"]}
    return {key: without_um / each["rms_um"] if each["rms_um"] > 0.0 else None for key, each in left.items()}


def _format_report(report: Mapping[str, Any]) -> str:
    name, measured, half = Path(report["program"]).name, report["measured"], report["predicted"]["uncertainty_um"]
    predicted = report["predicted"]["rms_um"]
    shown = f"{predicted:.2f} by the model" if half is None else format_upper_limit(predicted, half)
    text = f"pass {report['pass']} of {name}: contour error measured {measured['rms_um']:.2f} um RMS,"
    text += f" {measured['max_um']:.1f} at most (predicted {shown};"
    text += f" without correction {report['predicted_without']['rms_um']:.1f} predicted"
    gain = report["gain"]
    if gain["predicted"] is not None and gain["measured"] is not None:
        text += f"; gain {gain['measured']:.3g}, predicted {gain['predicted']:.3g}"
    text += ")"
    if report["ended_by"] == FINISHED:
        return text
    return f"{text}; it ended early: {report['late'] or report['ended_by']}"


def _format_learning(learned: LearnedOffset) -> str:
    newest = " ".join(f"{left_um:.2f}" for left_um in learned.curve_um[-SHOWN_CURVE:])
    return f"; learned from {len(learned.curve_um)} passes; residuals of the last ones {newest} um"


def _make_notice(report: Mapping[str, Any], text: str) -> Notice:
    measured, half = report["measured"]["rms_um"], report["predicted"]["uncertainty_um"]
    if report["late"]:
        return Notice("PassMeasured", "minor", f"{text}; reduce the load of this PC, then arm again")
    if measured > WORSE * report["predicted_without"]["rms_um"]:
        return Notice("PassMeasured", "MAJOR", f"{text}: worse than uncorrected; leave it off and identify again")
    if half is not None and measured > report["predicted"]["rms_um"] + half:
        return Notice("PassMeasured", "minor", f"{text}: more than predicted; identify again")
    return Notice("PassMeasured", "info", text)
