"""Many recordings at once: analysed in this process when few, on every core when many."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

from fdhil.api.analysis import FileResult, Progress, analyse_recordings, ignore_progress
from fdhil.api.compiling import forewarn
from fdhil.child import end_with
from fdhil.cli.failing import error_document
from fdhil.config import Identification, MachineConfig
from fdhil.errors import FdhilError, RecordingError
from fdhil.fleet.spread import Crew
from fdhil.records import Reason, Recording, Verdict, Window, WindowOutcome
from fdhil.store import suffixes
from fdhil.store.accelerometer_csv import with_accelerometer
from fdhil.store.column_map import ColumnMap
from fdhil.store.recordings import read_recording, read_stored

MANY_FILES = 16  # from here on further processes pay for their start
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
    """Yield the result of each recording in order, also of those that cannot be read.

    The ``machine``, where it is known, tells the rapid speed of recordings that do not say theirs, the regulators, and
    what a recording without voltage cannot. ``progress`` is told the share of a file that each step was: a window of
    it, or the whole.
    """
    if len(paths) < MANY_FILES or _cores() < 2:
        for path in paths:
            yield analyse_file(path, settings, machine, progress, accelerometer, columns, any_move)
        return
    forewarn("identify")
    analyse = partial(analyse_file, settings=settings, machine=machine, columns=columns, any_move=any_move)
    work = partial(_analyse_some, analyse=analyse)
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


def _analyse_some(numbered: Sequence[_Numbered], analyse: Callable[[Path], FileResult]) -> list[FileResult]:
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
    """Return the windows of one recording analysed, and their pool, or why it cannot be read."""
    try:
        recorded = read_recorded(path, accelerometer, columns)
    except FdhilError as error:
        progress(1.0)
        reason = Reason(type(error).__name__, str(error))
        return FileResult(str(path), None, (), None, Verdict(False, None, (reason,)), error_document(error))
    if multiprocessing.parent_process() is None:
        forewarn("identify")
    return analyse_recordings(
        [recorded], str(path), settings, machine, any_move=any_move, spread=_outcomes, progress=progress
    )


def read_recorded(path: Path, accelerometer: Path | None, columns: ColumnMap | None) -> Recording | Window:
    if next(os.walk(path), None) is not None:  # a folder: what is in it would be given in its place
        known = ", ".join(suffixes.RECORDINGS)
        raise RecordingError(f"{path} has no recordings ({known}); give the folder that has them")
    if accelerometer is None and columns is None and (stored := read_stored(path)) is not None:
        return stored
    recording = read_recording(path, columns)
    return recording if accelerometer is None else with_accelerometer(recording, accelerometer)


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
