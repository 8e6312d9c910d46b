"""Marks a commissioning record as void: something against it was seen, and it was not compared since.

A drive that has rebooted may have lost what is not stored in it; one that another master wrote to may be set up anew.
The mark is a file of its own, so that it outlives every process; comparing the drive again removes it.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

from fdhil.errors import StoreError


def void_path(directory: Path, axis: str) -> Path:
    """Return where the mark of an axis is kept."""
    return directory / f"commissioning-{axis}.void"


def is_void(directory: Path, axis: str) -> bool:
    """Whether the axis' record is void; also where that cannot be told."""
    try:
        void_path(directory, axis).lstat()
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return True


def void_record(directory: Path, axis: str, why: str) -> None:
    """Mark the axis' record as void, with the first reason; StoreError when the mark cannot be written."""
    path = void_path(directory, axis)
    if path.exists():
        return
    text = json.dumps({"why": why, "seen_utc": datetime.now(UTC).isoformat(timespec="seconds")})
    try:
        directory.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", "utf-8")
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written ({error.strerror}); until then arm nothing after a restart of the guard"
        ) from None


def confirm_record(directory: Path, axis: str) -> None:
    """Remove the mark: the drive was compared with its record, or commissioned anew. StoreError."""
    path = void_path(directory, axis)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be removed ({error.strerror}); check the rights of the store") from None
