"""Keeps what the passes of a program have taught: one file for each program and configuration."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from fdhil.correction.learning import Lesson
from fdhil.store.atomic import store_error, write_file

SCHEMA = "fdhil-lesson-1"
MOST_PROGRAMS = 50  # the oldest lessons go
MOST_PASSES = 200  # of a curve


def lesson_path(folder: Path, program_digest: str, config_digest: str) -> Path:
    """Return where the lesson of a program on this very machine is."""
    return folder / f"{program_digest[:32]}-{config_digest}.npz"


def read_lesson(path: Path) -> Lesson | None:
    """Return the lesson; None where there is none, or what is there cannot be one: it is learned anew."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as found:
            if str(found["schema"]) != SCHEMA:
                return None
            offsets = {str(axis): np.asarray(found[f"offset_{axis}_um"], np.float64) for axis in found["axes"]}
            curve = tuple(float(value) for value in found["curve_um"])
            lesson = Lesson(offsets, float(found["without_um"]), float(found["gain"]), curve)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    finite = all(u.ndim == 1 and np.isfinite(u).all() for u in offsets.values())
    return lesson if offsets and finite and np.isfinite([lesson.without_um, lesson.gain]).all() else None


def write_lesson(path: Path, lesson: Lesson) -> None:
    """Make a lesson durable; the oldest of other programs go. StoreError when it cannot be written."""
    content = io.BytesIO()
    np.savez_compressed(
        content,
        schema=np.array(SCHEMA),
        axes=np.array(list(lesson.offset_um)),
        without_um=np.array(lesson.without_um),
        gain=np.array(lesson.gain),
        curve_um=np.array(lesson.curve_um[-MOST_PASSES:]),
        **{f"offset_{axis}_um": offset for axis, offset in lesson.offset_um.items()},  # type: ignore[arg-type]
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        newest = sorted(path.parent.glob("*.npz"), key=lambda file: file.stat().st_mtime, reverse=True)
        for file in newest[MOST_PROGRAMS - 1 :]:
            file.unlink(missing_ok=True)
    except OSError as error:
        raise store_error(path, error) from None
    write_file(path, content.getvalue())
