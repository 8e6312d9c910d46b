"""Mark a commissioning record as void: something contradicts it, and the drive has not been compared since.

A drive that has rebooted may have lost settings that it does not store; one that another master wrote to may have been
reconfigured. The mark is a file, so that it outlives every process. Comparing the drive again removes it, unless a new
contradiction meanwhile has made another mark.
"""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.store import make_folder, sync_folder

MOST_BYTES, MOST_REASON = 64 * 1024, 300


def build_mark_path(directory: Path, axis: str) -> Path:
    """Return the mark file of an axis."""
    return directory / f"commissioning-{axis}.void"


Mark = tuple[int, int]
"""Identifies a mark."""


def is_record_void(directory: Path, axis: str) -> bool:
    """Return whether the axis' record is void, or whether that is unknown."""
    try:
        build_mark_path(directory, axis).lstat()
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return True


def read_void_reason(directory: Path, axis: str) -> str:
    """Return what contradicts the axis' record; empty if it cannot be read."""
    try:
        with build_mark_path(directory, axis).open("rb") as file:
            why = json.loads(file.read(MOST_BYTES))["why"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""
    return " ".join(str(why).split())[:MOST_REASON]


def read_void_mark(directory: Path, axis: str) -> Mark | None:
    """Return the present mark, to be read before the drive is compared; None without one."""
    try:
        status = build_mark_path(directory, axis).lstat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def mark_record_void(directory: Path, axis: str, why: str) -> None:
    """Mark the axis' record as void, with the newest reason; StoreError if the mark cannot be written."""
    path = build_mark_path(directory, axis)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    text = json.dumps({"why": why, "seen_utc": datetime.now(UTC).isoformat(timespec="seconds")})
    try:
        make_folder(directory)
        with part.open("w", encoding="utf-8") as file:
            part.rename(path)  # the mark is valid as soon as it exists, even if empty
            sync_folder(directory)
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written ({error.strerror}); until then do not arm after a restart of the guard"
        ) from None


def clear_void_mark(directory: Path, axis: str, seen: Mark | None) -> None:
    """Remove the mark ``seen`` before the drive was compared; a newer mark stays. StoreError."""
    path = build_mark_path(directory, axis)
    if seen is None or seen != read_void_mark(directory, axis):
        return
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be removed ({error.strerror}); check the rights of the store") from None
