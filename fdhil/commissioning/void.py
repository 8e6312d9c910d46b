"""Marks a commissioning record as void: something against it was seen, and it was not compared since.

A drive that has rebooted may have lost what is not stored in it; one that another master wrote to may be set up anew.
The mark is a file of its own, so that it outlives every process; comparing the drive again removes it, unless
something more was seen meanwhile: that makes another mark.
"""

import json
import os
from datetime import UTC, datetime
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.store.atomic import make_folder, sync_folder

MOST_BYTES, MOST_REASON = 64 * 1024, 300


def void_path(directory: Path, axis: str) -> Path:
    """Return where the mark of an axis is kept."""
    return directory / f"commissioning-{axis}.void"


Mark = tuple[int, int]
"""What tells one mark from another."""


def is_void(directory: Path, axis: str) -> bool:
    """Whether the axis' record is void; also where that cannot be told."""
    try:
        void_path(directory, axis).lstat()
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return True


def void_reason(directory: Path, axis: str) -> str:
    """Return what was seen against the axis' record, empty where that cannot be read."""
    try:
        with void_path(directory, axis).open("rb") as file:
            why = json.loads(file.read(MOST_BYTES))["why"]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return ""
    return " ".join(str(why).split())[:MOST_REASON]


def void_mark(directory: Path, axis: str) -> Mark | None:
    """Return which mark there is now: to be asked before the drive is compared. None: there is none."""
    try:
        status = void_path(directory, axis).lstat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


def void_record(directory: Path, axis: str, why: str) -> None:
    """Mark the axis' record as void, with the newest reason; StoreError when the mark cannot be written."""
    path = void_path(directory, axis)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    text = json.dumps({"why": why, "seen_utc": datetime.now(UTC).isoformat(timespec="seconds")})
    try:
        make_folder(directory)
        with part.open("w", encoding="utf-8") as file:
            part.rename(path)  # it is a mark as soon as it is there, even without a word in it
            sync_folder(directory)
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written ({error.strerror}); until then arm nothing after a restart of the guard"
        ) from None


def confirm_record(directory: Path, axis: str, seen: Mark | None) -> None:
    """Remove the mark that was ``seen`` before the drive was compared with its record; another stays. StoreError."""
    path = void_path(directory, axis)
    if seen is None or seen != void_mark(directory, axis):
        return
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise StoreError(f"{path} cannot be removed ({error.strerror}); check the rights of the store") from None
