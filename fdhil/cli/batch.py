"""Many recordings at once: analysed in this process when few, on every core when many."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from fdhil.child import end_with
from fdhil.cli.compiling import forewarn
from fdhil.cli.failing import error_document
from fdhil.config import Axis, Identification, MachineConfig
from fdhil.errors import FdhilError, RecordingError
from fdhil.fleet.spread import Crew
from fdhil.identification.windows import find_windows
from fdhil.pipeline import analyse_windows, pool_with_held_out
from fdhil.records import Estimate, HeldOut, LoopEstimate, Reason, Recording, Verdict, Window, WindowOutcome
from fdhil.store import suffixes
from fdhil.store.accelerometer_csv import with_accelerometer
from fdhil.store.column_map import ColumnMap
from fdhil.store.recording_parquet import stored_window
from fdhil.store.recording_table import NOTES, RECORD_HZ, SLOW_HZ, SOURCES
from fdhil.store.recordings import read_recording
from fdhil.validation.signal_consistency import missing_move

MANY_FILES = 16  # from here on further processes pay for their start
MANY_WINDOWS = 48
CHUNK = 8
Progress = Callable[[float], None]
_Numbered = tuple[int, Path]


@dataclass(frozen=True, slots=True)
class FileResult:
    """One recording: its windows analysed, and their pool; one that cannot be read has an ``error`` and no axis.

    ``loops`` are the drive's own, where the configured ones did not explain its rapids. ``held_out`` is what the pool
    leaves of moves that it was not identified on.
    """

    file: str
    axis: str | None
    outcomes: tuple[WindowOutcome, ...]
    pooled: Estimate | None
    verdict: Verdict
    error: Mapping[str, Any] | None = None
    loops: LoopEstimate | None = None
    held_out: HeldOut | None = None


def unseen(share: float) -> None:
    """Tell nobody how far the work is."""


def analyse_files(
    paths: Sequence[Path],
    settings: Identification,
    machine: MachineConfig | None = None,
    progress: Progress = unseen,
    accelerometer: Path | None = None,
    columns: ColumnMap | None = None,
) -> Iterator[FileResult]:
    """Yield the result of each recording in order, also of those that cannot be read.

    The ``machine``, where it is known, tells the rapid speed of recordings that do not say theirs, the regulators, and
    what a recording without voltage cannot. ``progress`` is told the share of a file that each step was: a window of
    it, or the whole.
    """
    if len(paths) < MANY_FILES or _cores() < 2:
        for path in paths:
            yield analyse_file(path, settings, machine, progress, accelerometer, columns)
        return
    forewarn("identify")
    work = partial(_analyse_some, settings=settings, machine=machine, columns=columns)
    ready: dict[int, FileResult] = {}
    first = 0
    try:
        with _processes() as executor:
            crew = Crew[_Numbered, FileResult](executor, CHUNK, 2 * _cores())
            for task, results in crew.spread(work, enumerate(paths)):
                progress(len(task))
                ready |= {number: result for (number, _), result in zip(task, results, strict=True)}
                while first in ready:
                    yield ready.pop(first)
                    first += 1
    except BrokenProcessPool:
        text = "a process that analysed recordings was ended from outside, as when the memory is used up"
        raise FdhilError(f"{text}; nothing is told of any: give fewer at once, or free memory") from None


def _analyse_some(
    numbered: Sequence[_Numbered], settings: Identification, machine: MachineConfig | None, columns: ColumnMap | None
) -> list[FileResult]:
    return [analyse_file(path, settings, machine, columns=columns) for _, path in numbered]


def analyse_file(
    path: Path,
    settings: Identification,
    machine: MachineConfig | None = None,
    progress: Progress = unseen,
    accelerometer: Path | None = None,
    columns: ColumnMap | None = None,
) -> FileResult:
    """Return the windows of one recording analysed, and their pool, or why it cannot be read."""
    try:
        recorded = _read(path, accelerometer, columns)
    except FdhilError as error:
        progress(1.0)
        reason = Reason(type(error).__name__, str(error))
        return FileResult(str(path), None, (), None, Verdict(False, None, (reason,)), error_document(error))
    if multiprocessing.parent_process() is None:
        forewarn("identify")
    axis = None if machine is None else machine.axis.get(recorded.axis)
    windows, settings = _windows(recorded, axis), _told_by(recorded, settings)
    period_s = None if machine is None else machine.machine.sync_period_s
    step = partial(progress, 1.0 / (len(windows) + 1))
    outcomes, loops = analyse_windows(windows, settings, axis, period_s, _outcomes, step)
    outcomes, estimate, verdict, held_out, loops = pool_with_held_out(outcomes, settings, axis, loops, period_s)
    if not windows and isinstance(recorded, Recording) and (hidden := missing_move(recorded)) is not None:
        verdict = replace(verdict, reasons=(*verdict.reasons, hidden))
    step()
    return FileResult(
        str(path), recorded.axis, tuple(outcomes), estimate, _of_reading(recorded, verdict), None, loops, held_out
    )


def _read(path: Path, accelerometer: Path | None, columns: ColumnMap | None) -> Recording | Window:
    if next(os.walk(path), None) is not None:  # a folder: what is in it would be given in its place
        known = ", ".join(suffixes.RECORDINGS)
        raise RecordingError(f"{path} has no recordings ({known}); give the folder that has them")
    if accelerometer is None and columns is None and (stored := stored_window(path)) is not None:
        return stored
    recording = read_recording(path, columns)
    return recording if accelerometer is None else with_accelerometer(recording, accelerometer)


def _of_reading(recorded: Recording | Window, verdict: Verdict) -> Verdict:
    """Return the verdict with what its file explains: numbers changed as they were read, and samples far apart."""
    notes = None if isinstance(recorded, Window) else recorded.headers.get(NOTES)
    if notes is not None:
        read = Reason("ReadOtherwise", notes, "compare with the file")
        verdict = replace(verdict, warnings=(*verdict.warnings, read))
    if verdict.accepted or recorded.dt_s <= 1 / SLOW_HZ:
        return verdict
    text = f"{1 / recorded.dt_s:.4g} Hz is too slow to follow how a drive accelerates"
    slow = Reason("LowExcitation", text, f"record at {RECORD_HZ} Hz or faster")
    return replace(verdict, reasons=(slow, *verdict.reasons))


def _windows(recorded: Recording | Window, axis: Axis | None) -> list[Window]:
    if isinstance(recorded, Window):
        return [recorded]
    return find_windows(recorded, None if axis is None else axis.rapid_speed_rad_s)


def _told_by(recorded: Recording | Window, settings: Identification) -> Identification:
    """Return the settings with what a recording itself says of where its speed and its voltage come from."""
    headers = {} if isinstance(recorded, Window) else recorded.headers
    told = {key: headers[key] for key in SOURCES if key in headers}
    return settings.model_copy(update=told) if told else settings


def _outcomes(work: Callable[[Window], WindowOutcome], windows: Sequence[Window]) -> Iterator[WindowOutcome]:
    if len(windows) < MANY_WINDOWS or _cores() < 2 or multiprocessing.parent_process() is not None:
        yield from map(work, windows)
        return
    with _processes() as executor:
        yield from executor.map(work, windows, chunksize=CHUNK)


def _cores() -> int:
    return os.cpu_count() or 1


def _processes() -> ProcessPoolExecutor:
    """Return processes that are spawned, not forked: a progress display has threads. They end with this one."""
    spawning = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(_cores(), spawning, initializer=end_with, initargs=(os.getpid(),))
