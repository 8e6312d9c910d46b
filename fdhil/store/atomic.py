"""Writing a file so that a reader sees all of it or nothing, also after a power cut."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from fdhil.errors import StoreError

_CODES = {
    errno.ENOSPC: "DiskFull",
    errno.EDQUOT: "DiskFull",
    errno.EROFS: "ReadOnlyStore",
    errno.EACCES: "ReadOnlyStore",
}
_CAUSES = {
    "DiskFull": "the disk is full; free space or lower keep_windows in [store]",
    "ReadOnlyStore": "it may not be written; check the rights and the mount of [store] directory",
}


def store_error(path: Path, error: OSError) -> StoreError:
    """Say what an operating system's refusal means for the store; ``code`` is DiskFull, ReadOnlyStore or StoreFault."""
    code = _CODES.get(error.errno or 0, "StoreFault")
    cause = _CAUSES.get(code, f"{error.strerror}; check the disk, the file is not tried again")
    return StoreError(f"{path} could not be written: {cause}", code)


def write_file(path: Path, content: bytes) -> None:
    """Write ``content`` under a temporary name, fsync, rename, fsync the folder. StoreError when any step fails.

    The temporary name is fixed (``.NAME.part``), so that what a power cut leaves behind is overwritten, never piled up.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        try:
            _write_all(descriptor, content)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        part.rename(path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise store_error(path, error) from None


def _write_all(descriptor: int, content: bytes) -> None:
    view = memoryview(content)
    while view:  # a write may be short
        view = view[os.write(descriptor, view) :]


def sync_folder(folder: Path) -> None:
    """Make renames and unlinks in ``folder`` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
