"""Analysis of recordings: few in this process, many on every core."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

from fdhil.api import FileResult, Progress, analyse_recordings, announce_compilation, ignore_progress
from fdhil.child_process import request_parent_death_signal
from fdhil.cli.cli_errors import describe_error
from fdhil.config import Identification, MachineConfig
from fdhil.errors import FdhilError, RecordingError
from fdhil.fleet import TaskPool
from fdhil.records import Reason, Recording, Verdict, Window, WindowOutcome
from fdhil.store import RECORDING_SUFFIXES, ColumnMap, add_accelerometer, read_recording, read_stored_window

MANY_FILES = 16  # above this, further processes pay for their start
MANY_WINDOWS = 48
CHUNK = 8
_Numbered = tuple[int, Path]


def analyse_files(
    paths: Sequence[Path],
    settings: Identification,
    machine: MachineConfig | None = None,
    progress: Progress = ignore_progress,
    accelerometer: Path | None = None,
    columns: ColumnMap | None = None,
    any_move: bool = False,
) -> Iterator[FileResult]:
    """Yield the result of each recording in order, including those that cannot be read.

    ``machine`` provides the regulators, the rapid speed of recordings without one, and the parameters that a recording
    without voltage cannot determine. ``progress`` is called with the share of a file that each step completed.
    """
    if len(paths) < MANY_FILES or _count_cores() < 2:
        for path in paths:
            yield analyse_file(path, settings, machine, progress, accelerometer, columns, any_move)
        return
    announce_compilation("identify")
    analyse = partial(analyse_file, settings=settings, machine=machine, columns=columns, any_move=any_move)
    work = partial(_analyse_chunk, analyse=analyse)
    ready: dict[int, FileResult] = {}
    first = 0
    try:
        with _create_process_pool() as executor:
            pool = TaskPool[_Numbered, FileResult](executor, CHUNK, 2 * _count_cores())
            for task, results in pool.run_tasks(work, enumerate(paths)):
                progress(len(task))
                ready |= {number: result for (number, _), result in zip(task, results, strict=True)}
                while first in ready:
                    yield ready.pop(first)
                    first += 1
    except BrokenProcessPool:
        text = "a process that analyses recordings was killed, probably for lack of memory"
        raise FdhilError(f"{text}; no result is shown: give fewer recordings, or free memory") from None


def _analyse_chunk(numbered: Sequence[_Numbered], analyse: Callable[[Path], FileResult]) -> list[FileResult]:
    return [analyse(path) for _, path in numbered]


def analyse_file(
    path: Path,
    settings: Identification,
    machine: MachineConfig | None = None,
    progress: Progress = ignore_progress,
    accelerometer: Path | None = None,
    columns: ColumnMap | None = None,
    any_move: bool = False,
) -> FileResult:
    """Return the analysed windows of one recording and their pool, or the reason why it cannot be read."""
    try:
        recorded = read_recording_or_window(path, accelerometer, columns)
    except FdhilError as error:
        progress(1.0)
        reason = Reason(type(error).__name__, str(error))
        return FileResult(str(path), None, (), None, Verdict(False, None, (reason,)), describe_error(error))
    if multiprocessing.parent_process() is None:
        announce_compilation("identify")
    return analyse_recordings(
        [recorded], str(path), settings, machine, any_move=any_move, spread=_analyse_windows, progress=progress
    )


def read_recording_or_window(path: Path, accelerometer: Path | None, columns: ColumnMap | None) -> Recording | Window:
    if next(os.walk(path), None) is not None:  # a folder without recordings; others are expanded before
        known = ", ".join(RECORDING_SUFFIXES)
        raise RecordingError(f"{path} has no recordings ({known}); give the folder that has them")
    if accelerometer is None and columns is None and (stored := read_stored_window(path)) is not None:
        return stored
    recording = read_recording(path, columns)
    return recording if accelerometer is None else add_accelerometer(recording, accelerometer)


def _analyse_windows(work: Callable[[Window], WindowOutcome], windows: Sequence[Window]) -> Iterator[WindowOutcome]:
    if len(windows) < MANY_WINDOWS or _count_cores() < 2 or multiprocessing.parent_process() is not None:
        yield from map(work, windows)
        return
    with _create_process_pool() as executor:
        yield from executor.map(work, windows, chunksize=CHUNK)


def _count_cores() -> int:
    return os.cpu_count() or 1


def _create_process_pool() -> ProcessPoolExecutor:
    # spawned, not forked: a progress display has threads; the processes end with this one
    spawning = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        _count_cores(), spawning, initializer=request_parent_death_signal, initargs=(os.getpid(),)
    )
