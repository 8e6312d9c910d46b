"""Analyses recordings for the command line and the Python interface: windows, estimates, pool, verdict."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from fdhil.config import Axis, Identification, MachineConfig
from fdhil.identification import estimate_locked_rotor, find_windows, is_rotor_locked, make_whole_window
from fdhil.pipeline import analyse_windows, pool_with_held_out
from fdhil.records import (
    Estimate,
    HeldOut,
    LoopEstimate,
    Parameters,
    Reason,
    Recording,
    Verdict,
    Window,
    WindowOutcome,
    make_read_only_view,
)
from fdhil.store import COLUMN_SOURCES, IMPORT_NOTES, PITCH_KEY, RECORD_HZ, SLOW_HZ
from fdhil.validation import detect_gain_error, explain_missing_move

Work = Callable[[Window], WindowOutcome]
Spread = Callable[[Work, Sequence[Window]], Iterable[WindowOutcome]]
Progress = Callable[[float], None]


def ignore_progress(share: float) -> None:
    """Ignore a progress report."""


@dataclass(frozen=True, slots=True)
class FileResult:
    """One recording: its analysed windows and their pool; an unreadable one has an ``error`` and no axis.

    ``loops`` are the drive's own, where the configured ones did not explain its rapids. ``held_out`` is the error of
    the pool in moves that it was not identified from.
    """

    file: str
    axis: str | None
    outcomes: tuple[WindowOutcome, ...]
    pooled: Estimate | None
    verdict: Verdict
    error: Mapping[str, Any] | None = None
    loops: LoopEstimate | None = None
    held_out: HeldOut | None = None


def analyse_recordings(
    recorded: Sequence[Recording | Window],
    name: str,
    settings: Identification,
    machine: MachineConfig | None = None,
    *,
    any_move: bool = False,
    spread: Spread = map,
    progress: Progress = ignore_progress,
) -> FileResult:
    """Analyse the windows of recordings of one axis, and pool them.

    With ``any_move`` each recording is one window, whatever its moves are. ``spread`` maps in order, possibly over
    several processes; ``progress`` receives the share of each step.
    """
    first = recorded[0]
    axis = None if machine is None else machine.axis.get(first.axis)
    recorded = [_apply_axis_pitch(each, axis) for each in recorded]
    windows = [window for each in recorded for window in _select_windows(each, axis, any_move=any_move)]
    settings = _apply_recording_sources(first, settings)
    period_s = None if machine is None else machine.machine.sync_period_s
    step = partial(progress, 1.0 / (len(windows) + 1))
    turning = [window for window in windows if not is_rotor_locked(window)]
    outcomes, loops = analyse_windows(turning, settings, axis, period_s, spread, step)
    if windows and not turning:
        return _analyse_locked_rotor(windows, name, first.axis)
    outcomes, estimate, verdict, held_out, loops = pool_with_held_out(outcomes, settings, axis, loops, period_s)
    if not windows and isinstance(first, Recording) and (hidden := explain_missing_move(first)) is not None:
        verdict = replace(verdict, reasons=(*verdict.reasons, hidden))
    step()
    verdict = _add_reading_notes(first, verdict)
    return FileResult(name, first.axis, tuple(outcomes), estimate, verdict, None, loops, held_out)


def _apply_axis_pitch(recorded: Recording | Window, axis: Axis | None) -> Recording | Window:
    if axis is None or isinstance(recorded, Window) or not recorded.headers or PITCH_KEY in recorded.headers:
        return recorded
    share = axis.screw_pitch_mm / recorded.pitch_mm
    return replace(
        recorded, pitch_mm=axis.screw_pitch_mm, position_mm=make_read_only_view(share * recorded.position_mm)
    )


def _analyse_locked_rotor(windows: Sequence[Window], name: str, axis: str) -> FileResult:
    """Return R and L of the last recording of a rotor that does not turn."""
    reason = Reason(
        "LowExcitation", "the rotor does not turn: only R and L can be determined", "record a turning rotor too"
    )
    verdict = Verdict(False, None, (reason,))
    measured = [window for window in windows if window.voltage_v is not None]
    known = [WindowOutcome(window, estimate_locked_rotor(window), verdict) for window in measured]
    return FileResult(name, axis, tuple(known), known[-1].estimate if known else None, verdict)


def _add_reading_notes(recorded: Recording | Window, verdict: Verdict) -> Verdict:
    notes = None if isinstance(recorded, Window) else recorded.headers.get(IMPORT_NOTES)
    if notes is not None:
        read = Reason("ReadOtherwise", notes, "compare with the file")
        verdict = replace(verdict, warnings=(*verdict.warnings, read))
    if verdict.accepted or recorded.dt_s <= 1 / SLOW_HZ:
        return verdict
    text = f"{1 / recorded.dt_s:.4g} Hz is too slow to resolve a drive's acceleration"
    slow = Reason("LowExcitation", text, f"record at {RECORD_HZ} Hz or faster")
    return replace(verdict, reasons=(slow, *verdict.reasons))


def _select_windows(recorded: Recording | Window, axis: Axis | None, *, any_move: bool) -> list[Window]:
    if isinstance(recorded, Window):
        return [recorded]
    if any_move:
        return [make_whole_window(recorded)]
    return find_windows(recorded, None if axis is None else axis.rapid_speed_rad_s)


def _apply_recording_sources(recorded: Recording | Window, settings: Identification) -> Identification:
    headers = {} if isinstance(recorded, Window) else recorded.headers
    sources = {key: headers[key] for key in COLUMN_SOURCES if key in headers}
    return settings.model_copy(update=sources) if sources else settings


def compare_with_data_sheet(result: FileResult, axes: Mapping[str, Axis]) -> FileResult:
    """Refuse a pool that differs from the axis' nominal values by a sensor's gain; warn without nominal values."""
    verdict = result.verdict
    if result.axis is not None and result.axis not in axes:
        text = f"axis {result.axis} is not in the configuration: nothing was compared with its nominal values"
        unknown = Reason("NoSuchAxis", text, f"add [axis.{result.axis}], or give the configuration of its machine")
        return replace(result, verdict=replace(verdict, warnings=(*verdict.warnings, unknown)))
    if result.axis is None or result.pooled is None or not verdict.accepted:
        return result
    reason = detect_gain_error(result.pooled, Parameters(**axes[result.axis].nominal.model_dump()))
    if reason is None:
        return result
    return replace(result, verdict=replace(verdict, accepted=False, reasons=(reason,)))
