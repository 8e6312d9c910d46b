"""Stores learned offsets (iterative learning control): one file for each program and configuration."""

import io
import zipfile
from pathlib import Path

import numpy as np

from fdhil.correction import LearnedOffset
from fdhil.store.atomic_file import keep_newest, make_folder, make_store_error, write_file
from fdhil.store.recording_table import UNREADABLE

SCHEMA = "fdhil-lesson-1"
MOST_PROGRAMS = 50  # the oldest files are removed
MOST_PASSES = 200  # of a curve


def make_learned_path(folder: Path, program_digest: str, config_digest: str) -> Path:
    """Return the file of a program's learned offsets on this machine."""
    return folder / f"{program_digest[:32]}-{config_digest}.npz"


def list_learned(folder: Path, config_digest: str) -> list[tuple[float, str, LearnedOffset]]:
    """Return the learned offsets for one configuration, newest first, each with its time (Unix, s) and program.

    The program is given by the first 32 digits of its digest. Unreadable files are left out.
    """
    found = []
    for path in folder.glob(f"*-{config_digest}.npz"):
        try:
            written_s = path.stat().st_mtime
        except FileNotFoundError:  # the daemon removed it in the meantime
            continue
        learned = read_learned(path)
        if learned is not None:
            found.append((written_s, path.name.partition("-")[0], learned))
    return sorted(found, key=lambda entry: -entry[0])


def read_learned(path: Path) -> LearnedOffset | None:
    """Return the learned offsets; None if there are none or the file is invalid: learning then starts again."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as found:
            if str(found["schema"]) != SCHEMA:
                return None
            offsets = {str(axis): np.asarray(found[f"offset_{axis}_um"], np.float64) for axis in found["axes"]}
            curve = tuple(float(value) for value in found["curve_um"])
            learned = LearnedOffset(offsets, float(found["without_um"]), float(found["gain"]), curve)
    except (zipfile.BadZipFile, *UNREADABLE):
        return None
    finite = all(u.ndim == 1 and np.isfinite(u).all() for u in offsets.values())
    return learned if offsets and finite and np.isfinite([learned.without_um, learned.gain]).all() else None


def write_learned(path: Path, learned: LearnedOffset) -> None:
    """Store learned offsets durably; the oldest of other programs are removed. Raises StoreError."""
    content = io.BytesIO()
    np.savez_compressed(
        content,
        schema=np.array(SCHEMA),
        axes=np.array(list(learned.offset_um)),
        without_um=np.array(learned.without_um),
        gain=np.array(learned.gain),
        curve_um=np.array(learned.curve_um[-MOST_PASSES:]),
        **{f"offset_{axis}_um": offset for axis, offset in learned.offset_um.items()},  # type: ignore[arg-type]
    )
    try:
        make_folder(path.parent)
        write_file(path, content.getvalue())
        others = [file for file in path.parent.glob("*.npz") if file != path]
        keep_newest(path, others, MOST_PROGRAMS)
    except OSError as error:
        raise make_store_error(path, error) from None
