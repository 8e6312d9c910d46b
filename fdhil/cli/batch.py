"""Many recordings at once: analysed in this process when few, on every core when many."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from fdhil.cli.compiling import forewarn
from fdhil.cli.failing import error_document
from fdhil.config import Identification, MachineConfig
from fdhil.errors import FdhilError
from fdhil.identification.windows import find_windows
from fdhil.pipeline import analyse, pool
from fdhil.pipeline.own_loops import explained
from fdhil.records import Estimate, LoopEstimate, Reason, Recording, Verdict, Window, WindowOutcome
from fdhil.store.accelerometer_csv import with_accelerometer
from fdhil.store.column_map import ColumnMap
from fdhil.store.recording_table import SOURCES
from fdhil.store.recordings import read_recording

MANY_FILES = 16  # from here on further processes pay for their start
MANY_WINDOWS = 48
CHUNK = 8
Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class FileResult:
    """One recording: its windows analysed, and their pool; one that cannot be read has an ``error`` and no axis.

    ``loops`` are the drive's own, where the configured ones did not explain its rapids.
    """

    file: str
    axis: str | None
    outcomes: tuple[WindowOutcome, ...]
    pooled: Estimate | None
    verdict: Verdict
    error: Mapping[str, Any] | None = None
    loops: LoopEstimate | None = None


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
    work = partial(analyse_file, settings=settings, machine=machine, columns=columns)
    with _processes() as executor:
        for result in executor.map(work, paths, chunksize=CHUNK):
            progress(1.0)
            yield result


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
        recording = read_recording(path, columns)
        if accelerometer is not None:
            recording = with_accelerometer(recording, accelerometer)
    except FdhilError as error:
        progress(1.0)
        reason = Reason(type(error).__name__, str(error))
        return FileResult(str(path), None, (), None, Verdict(False, None, (reason,)), error_document(error))
    if multiprocessing.parent_process() is None:
        forewarn("identify")
    first = []
    axis = None if machine is None else machine.axis.get(recording.axis)
    settings = told_by(recording, settings)
    windows = find_windows(recording, None if axis is None else axis.rapid_speed_rad_s)
    period_s = None if machine is None else machine.machine.sync_period_s
    work = partial(analyse, settings=settings, axis=axis, sync_period_s=period_s)
    for outcome in _outcomes(windows, work):
        first.append(outcome)
        progress(1.0 / (len(windows) + 1))
    outcomes, loops = explained(
        first, axis, settings, period_s, lambda own: list(_outcomes(windows, partial(work, axis=own)))
    )
    estimate, verdict = pool(outcomes, settings)
    progress(1.0 / (len(windows) + 1))
    return FileResult(str(path), recording.axis, tuple(outcomes), estimate, verdict, loops=loops)


def told_by(recording: Recording, settings: Identification) -> Identification:
    """Return the settings with what a recording itself says of where its speed and its voltage come from."""
    told = {key: recording.headers[key] for key in SOURCES if key in recording.headers}
    return settings.model_copy(update=told) if told else settings


def _outcomes(windows: Sequence[Window], work: Callable[[Window], WindowOutcome]) -> Iterator[WindowOutcome]:
    if len(windows) < MANY_WINDOWS or _cores() < 2 or multiprocessing.parent_process() is not None:
        yield from map(work, windows)
        return
    with _processes() as executor:
        yield from executor.map(work, windows, chunksize=CHUNK)


def _cores() -> int:
    return os.cpu_count() or 1


def _processes() -> ProcessPoolExecutor:
    """Return processes that are spawned, not forked: a progress display has threads."""
    return ProcessPoolExecutor(_cores(), mp_context=multiprocessing.get_context("spawn"))
