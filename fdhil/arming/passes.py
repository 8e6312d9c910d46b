"""Measures the contour error that a correction leaves in each pass of its program, by the drives' own feedback.

The daemon hears the NC's targets and the drives' positions; from the first motion after the arming to the program's
end they are compared as a prediction is. Samples are taken in the loop, all else is done in ``digest``, in a thread.
"""

from __future__ import annotations

import math
import sys
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fdhil.arming.lessons import Pupil
from fdhil.config import MachineConfig
from fdhil.correction import gate
from fdhil.correction.learning import Lesson
from fdhil.errors import StoreError
from fdhil.prediction import contour_error_um
from fdhil.prediction.contour import WINDOW_S
from fdhil.prediction.gain import format_upper_limit
from fdhil.records import AxisSamples, Float, Int, MoveKind, NcState, Notice, Parameters, Reason, table_path
from fdhil.system_clock import SYSTEM_CLOCK, Clock

Rows = tuple[Int, Float, Float]
"""Tick, demand and position (n,) of an axis."""
KEPT = 20
CHUNK_S = 2.0  # that is compared at once
LATE_S = 0.5  # by which samples may come behind the guard's word
MOST_BLOCKS = 1000
MOST_LEAD_S = 10.0
TOLERANCE_INCREMENTS = 2.5
WORSE = 1.05  # times the error predicted without a correction
SHOWN_CURVE = 8  # passes
FULL_OVERRIDE = 0.005  # by which one of 100 % may be off
FINISHED = "Finished"  # the guard's word for a program that ran to its end


class _Ended(NamedTuple):
    """A pass that the guard has ended; its last samples may come until ``due_s``."""

    running: Pass
    models: Mapping[str, Parameters]
    due_s: float
    cause: str
    summary: Mapping[str, Any]
    late: str


class Passes:
    """The pass that runs, and what the last ones measured."""

    def __init__(self, config: MachineConfig, clock: Clock = SYSTEM_CLOCK) -> None:
        self._config, self._clock = config, clock
        self._count = Counter[str]()
        self._running: Pass | None = None
        self._models: Mapping[str, Parameters] = {}
        self._broken: dict[str, tuple[Mapping[str, Parameters], Reason]] = {}
        self._ended: deque[_Ended] = deque()
        self._taken: deque[AxisSamples] = deque()
        self.told: deque[Mapping[str, Any]] = deque(maxlen=KEPT)

    def begin(
        self,
        demand: Mapping[str, Sequence[int]],
        rows: int | None,
        models: Mapping[str, Parameters],
        pupil: Pupil | None = None,
        ahead_mm: Float | None = None,
    ) -> None:
        """A program is about to be armed: the first rows of its table in increments, how many there are, who learns.

        ``ahead_mm`` (n, axes) is what the tables are ahead of what the encoders see, where that is known.
        """
        self._running = Pass(self._config, demand, rows, pupil, ahead_mm)
        self._models = models

    def broken(self, program_digest: str, models: Mapping[str, Parameters]) -> Reason | None:
        """Return why a program is not corrected again by the same models: its last pass was not what they promised."""
        found = self._broken.get(program_digest)
        return None if found is None or found[0] != models else found[1]

    def forget(self) -> None:
        """It was not armed."""
        self._running = None

    def take(self, samples: AxisSamples) -> None:
        """Take samples while a pass may run."""
        if self._running is not None or self._ended:
            self._taken.append(samples)

    def hear_nc(self, state: NcState) -> None:
        """Take what the NC says while a pass may run."""
        if self._running is not None:
            self._running.hear_nc(state)

    def end(self, cause: str, summary: Mapping[str, Any], late: str = "") -> None:
        """The guard has ended the correction; ``late`` says how late this computer was where that was the cause."""
        if self._running is not None:
            due_s = self._clock.now_s() + LATE_S
            self._ended.append(_Ended(self._running, self._models, due_s, cause, summary, late))
            self._running = None

    def digest(self) -> list[Notice]:
        """Go on with what was taken (in a thread); return what the passes that are over have shown."""
        hearing = [each.running for each in tuple(self._ended)]
        if self._running is not None:
            hearing.append(self._running)
        while self._taken:
            samples = self._taken.popleft()
            for each in hearing:
                each.take(samples)
        notices = []
        while self._ended and self._clock.now_s() >= self._ended[0].due_s:
            ended = self._ended.popleft()
            measured = ended.running.measured()
            notices += [] if measured is None else self._tell(ended, measured)
        return notices

    def _tell(self, ended: _Ended, measured: Mapping[str, Any]) -> list[Notice]:
        summary = ended.summary
        digest = str(summary["program_digest"])
        self._count[digest] += 1
        told: dict[str, Any] = {
            "program": summary["program"],
            "program_digest": digest,
            "pass": self._count[digest],
            "ended_by": ended.cause,
            "late": ended.late,
            **measured,
            "predicted": {key: summary["after"].get(key) for key in ("rms_um", "uncertainty_um")},
            "predicted_without": {"rms_um": summary["before"]["rms_um"]},
            "gain": _gains(summary, measured),
        }
        lesson, notices = _learned(ended)
        text = _text(told) + ("" if lesson is None else _lesson_text(lesson))
        if ended.running.disturbed is not None:
            told["disturbed"] = ended.running.disturbed
            text += f"; {ended.running.disturbed}: nothing is learned from this pass"
        learned = {} if lesson is None else {"learned": {"passes": len(lesson.curve_um), "curve_um": lesson.curve_um}}
        self.told.append({**told, "text": text, **learned})
        self._keep_or_break(ended, told, text)
        return [_notice(told, text), *notices]

    def _keep_or_break(self, ended: _Ended, told: Mapping[str, Any], text: str) -> None:
        """Note a promise that a whole pass did not keep: the program is not corrected again by the same models."""
        digest = told["program_digest"]
        self._broken.pop(digest, None)
        if (
            ended.cause == FINISHED
            and ended.running.disturbed is None
            and told["measured"]["rms_um"] * gate.LEAST_GAIN > told["predicted_without"]["rms_um"]
        ):
            advice = "let the machine make a few rapids, which identify it again, then arm"
            self._broken[digest] = (ended.models, Reason("PromiseBroken", f"{text}: it was withdrawn", advice))


class Pass:
    """One pass: rows of all axes of the table, joined by their ticks; ``rows`` None: to the program's end."""

    def __init__(
        self,
        config: MachineConfig,
        demand: Mapping[str, Sequence[int]],
        rows: int | None,
        pupil: Pupil | None = None,
        ahead_mm: Float | None = None,
    ) -> None:
        self._pupil = pupil
        self._ahead_mm = ahead_mm
        self._heard: list[tuple[Float, Float]] = []
        self._left = rows if rows is not None else sys.maxsize
        self._axes = tuple(demand)
        self._dt_s = config.machine.sync_period_s
        self._margin = round(WINDOW_S / self._dt_s)
        scales = [config.axis[a].scaling.sign * config.axis[a].scaling.increments_per_mm for a in self._axes]
        path = np.column_stack([np.asarray(demand[a], dtype=np.float64) for a in self._axes]) / scales
        self._tolerance_mm = TOLERANCE_INCREMENTS / np.abs(scales)
        self._start_mm: Float = path[0]
        leaves = np.flatnonzero(self._away(path))
        self._lead = min(int(leaves[0]) if leaves.size else 0, round(MOST_LEAD_S / self._dt_s))
        self._waiting: dict[str, list[Rows]] = {axis: [] for axis in self._axes}
        self._demand: Float = np.empty((0, len(self._axes)))
        self._position: Float = np.empty((0, len(self._axes)))
        self._first = 0  # row of the buffer from which on nothing was compared yet
        self._begun = self._at_start = False
        self._rows, self._squares, self._max_um = 0, 0.0, 0.0
        self._following = np.zeros(len(self._axes))
        self.disturbed: str | None = None

    def _away(self, rows_mm: Float) -> Any:
        return np.any(np.abs(rows_mm - self._start_mm) > self._tolerance_mm, axis=1)

    def hear_nc(self, state: NcState) -> None:
        """Note what the NC did to the pass: the first that made it another than was planned."""
        if self.disturbed is None:
            self.disturbed = disturbance(state)

    def take(self, samples: AxisSamples) -> None:
        """Take a block of one axis; the rows that all axes have by then go on."""
        if samples.axis not in self._waiting or samples.tick.size == 0:
            return
        self._waiting[samples.axis].append((samples.tick, samples.demand_mm, samples.position_mm))
        if not all(self._waiting.values()):
            if len(self._waiting[samples.axis]) > MOST_BLOCKS:  # another axis is not heard at all
                self._waiting[samples.axis].clear()
            return
        blocks = {axis: _joined(waiting) for axis, waiting in self._waiting.items()}
        self._waiting = {axis: [] for axis in self._axes}
        if any(np.any(np.diff(tick) <= 0) for tick, _, _ in blocks.values()):  # the SYNC count began anew
            return
        last = min(int(tick[-1]) for tick, _, _ in blocks.values())
        for axis, (tick, demand, position) in blocks.items():
            if (later := tick > last).any():
                self._waiting[axis].append((tick[later], demand[later], position[later]))
        self._add(*_common([(t[t <= last], d[t <= last], p[t <= last]) for t, d, p in blocks.values()]))

    def _add(self, demand: Float, position: Float) -> None:
        left = None if self._begun else self._departure(demand)
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
            self._compare(len(self._demand) - self._margin)

    def _departure(self, demand: Float) -> int | None:
        """Return the row in which the demand leaves the program's start, having stood there; None while it does not."""
        away = self._away(demand)
        stood = np.concatenate([[self._at_start], ~away[:-1]])
        leaves = np.flatnonzero(away & stood)
        self._at_start = not away[-1] if away.size else self._at_start
        return int(leaves[0]) if leaves.size else None

    def _compare(self, end: int) -> None:
        """Add the errors of the rows up to ``end``; what no later row needs is dropped."""
        end = max(self._first, min(end, self._first + self._left))
        if end > self._first:
            position = self._position[self._first : end]
            if self._ahead_mm is not None:
                position = position + self._ahead_mm[self._rows : self._rows + len(position)]
            path, table = table_path(self._axes, self._demand), table_path(self._axes, position)
            error = contour_error_um(path, table, self._dt_s, self._first)
            self._rows, self._left = self._rows + error.size, self._left - error.size
            self._squares += float(error @ error)
            self._max_um = max(self._max_um, float(error.max()))
            self._following += np.sum((position - self._demand[self._first : end]) ** 2, axis=0) * 1e6
            if self._pupil is not None:
                self._heard.append((self._demand[self._first : end].copy(), position.copy()))
        drop = max(0, end - self._margin) if self._left else len(self._demand)
        self._demand, self._position, self._first = self._demand[drop:], self._position[drop:], max(0, end - drop)

    def measured(self) -> Mapping[str, Any] | None:
        """Return what was measured so far; None when the program has not begun."""
        if self._begun:
            self._compare(len(self._demand))
        if not self._rows:
            return None
        following = np.sqrt(self._following / self._rows)
        return {
            "rows": self._rows,
            "measured": {"rms_um": math.sqrt(self._squares / self._rows), "max_um": self._max_um},
            "following_rms_um": dict(zip(self._axes, following.tolist(), strict=True)),
        }

    def learn(self) -> Lesson | None:
        """Return what the pass, which is over, has taught; None where nobody learns or it was not the plan's."""
        if self._pupil is None or not self._heard:
            return None
        demand, position = (np.concatenate([rows[k] for rows in self._heard]) for k in range(2))
        return self._pupil.learn(demand, position)


def disturbance(state: NcState) -> str | None:
    """Return what an NC says that makes a running program another than was planned; None while nothing does."""
    where = "" if state.line is None else f" in line {state.line}"
    if state.held:
        return f"the NC held its feed{where}"
    override = state.rapid_override if state.motion is MoveKind.RAPID else state.feed_override
    moving = state.motion in (MoveKind.RAPID, MoveKind.FEED, MoveKind.ARC)
    if moving and override is not None and abs(override - 1.0) > FULL_OVERRIDE:
        return f"the NC's override was {100 * override:.0f} %{where}"
    return None


def _learned(ended: _Ended) -> tuple[Lesson | None, list[Notice]]:
    """Let a program learn from its pass; return what it knows then, and a notice where that could not be kept."""
    if ended.cause != FINISHED or ended.running.disturbed is not None:
        return None, []
    try:
        return ended.running.learn(), []
    except StoreError as error:
        return None, [Notice(error.code or "StoreFault", "minor", f"what the pass taught is lost: {error}")]


def _joined(blocks: Sequence[Rows]) -> Rows:
    tick, demand, position = (np.concatenate([block[k] for block in blocks]) for k in range(3))
    return tick, demand, position


def _common(axes: Sequence[Rows]) -> tuple[Float, Float]:
    """Return demand and position (n, axes) of the ticks that all axes have, whole rows only."""
    ticks = axes[0][0]
    for tick, _, _ in axes[1:]:
        ticks = np.intersect1d(ticks, tick, assume_unique=True)
    rows = [np.searchsorted(tick, ticks) for tick, _, _ in axes]
    demand = np.column_stack([axis[1][at] for axis, at in zip(axes, rows, strict=True)])
    position = np.column_stack([axis[2][at] for axis, at in zip(axes, rows, strict=True)])
    whole = np.isfinite(demand).all(axis=1) & np.isfinite(position).all(axis=1)
    return demand[whole], position[whole]


def _gains(summary: Mapping[str, Any], measured: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the predicted gain of a pass, and the one that was measured; None where nothing is left."""
    without_um, left = summary["before"]["rms_um"], {"predicted": summary["after"], "measured": measured["measured"]}
    return {key: without_um / each["rms_um"] if each["rms_um"] > 0.0 else None for key, each in left.items()}


def _text(told: Mapping[str, Any]) -> str:
    name, measured, half = Path(told["program"]).name, told["measured"], told["predicted"]["uncertainty_um"]
    predicted = told["predicted"]["rms_um"]
    shown = f"{predicted:.2f} by the model" if half is None else format_upper_limit(predicted, half)
    text = f"pass {told['pass']} of {name}: contour error measured {measured['rms_um']:.2f} um RMS,"
    text += f" {measured['max_um']:.1f} at most (predicted {shown};"
    text += f" without correction {told['predicted_without']['rms_um']:.1f} predicted"
    gain = told["gain"]
    if gain["predicted"] is not None and gain["measured"] is not None:
        text += f"; gain {gain['measured']:.3g}, predicted {gain['predicted']:.3g}"
    text += ")"
    if told["ended_by"] == FINISHED:
        return text
    return f"{text}; it ended early: {told['late'] or told['ended_by']}"


def _lesson_text(lesson: Lesson) -> str:
    newest = " ".join(f"{left_um:.2f}" for left_um in lesson.curve_um[-SHOWN_CURVE:])
    return f"; learning from {len(lesson.curve_um)} passes, the last left {newest} um"


def _notice(told: Mapping[str, Any], text: str) -> Notice:
    """Say what was measured, and louder where it is not what was promised."""
    measured, half = told["measured"]["rms_um"], told["predicted"]["uncertainty_um"]
    if told["late"]:
        return Notice("PassMeasured", "minor", f"{text}; take load off this PC, then arm again")
    if measured > WORSE * told["predicted_without"]["rms_um"]:
        return Notice("PassMeasured", "MAJOR", f"{text}: worse than without; leave it off and identify again")
    if half is not None and measured > told["predicted"]["rms_um"] + half:
        return Notice("PassMeasured", "minor", f"{text}: more than predicted; identify again")
    return Notice("PassMeasured", "info", text)
