"""Many recordings at once: analysed in this process when few, on every core when many."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from fdhil.config import Identification
from fdhil.identification.windows import find_windows
from fdhil.records import Estimate, Recording, Verdict, WindowOutcome
from fdhil.store.recording_csv import read_recording
from fdhil.validation import analyse, pool

MANY_FILES = 16  # from here on further processes pay for their start
MANY_WINDOWS = 48
CHUNK = 8


@dataclass(frozen=True, slots=True)
class FileResult:
    """One recording: its windows analysed, and their pool."""

    file: str
    axis: str
    outcomes: tuple[WindowOutcome, ...]
    pooled: Estimate | None
    verdict: Verdict


def analyse_files(
    paths: Sequence[Path], settings: Identification, rapid_speeds_rad_s: dict[str, float]
) -> Iterator[FileResult]:
    """Yield the result of each recording in order; RecordingError at the first that cannot be read.

    ``rapid_speeds_rad_s`` maps an axis to the machine's rapid speed, for recordings that do not say theirs.
    """
    work = partial(analyse_file, settings=settings, rapid_speeds_rad_s=rapid_speeds_rad_s)
    if len(paths) < MANY_FILES or (os.cpu_count() or 1) < 2:
        yield from map(work, paths)
        return
    with _processes() as executor:
        yield from executor.map(work, paths, chunksize=CHUNK)


def analyse_file(path: Path, settings: Identification, rapid_speeds_rad_s: dict[str, float]) -> FileResult:
    """Return the windows of one recording analysed, and their pool; RecordingError as :func:`read_recording`."""
    recording = read_recording(path)
    outcomes = _outcomes(recording, settings, rapid_speeds_rad_s.get(recording.axis))
    estimate, verdict = pool(outcomes, settings)
    return FileResult(str(path), recording.axis, outcomes, estimate, verdict)


def _outcomes(recording: Recording, settings: Identification, rapid: float | None) -> tuple[WindowOutcome, ...]:
    windows = find_windows(recording, rapid)
    work = partial(analyse, settings=settings)
    if len(windows) < MANY_WINDOWS or (os.cpu_count() or 1) < 2 or multiprocessing.parent_process() is not None:
        return tuple(map(work, windows))
    with _processes() as executor:
        return tuple(executor.map(work, windows, chunksize=CHUNK))


def _processes() -> ProcessPoolExecutor:
    # spawned, not forked: a progress display has threads
    return ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))
