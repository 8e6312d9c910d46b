"""Writes files atomically: a reader sees the whole file or nothing, also after a power cut."""

import contextlib
import errno
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from fdhil.errors import StoreError

PAGE_BYTES = 64 * 1024  # allocated by the history when it is opened
_CODES = {
    errno.ENOSPC: "DiskFull",
    errno.EDQUOT: "DiskFull",
    errno.EROFS: "ReadOnlyStore",
    errno.EACCES: "ReadOnlyStore",
}
CAUSES = {
    "DiskFull": "the disk is full; free space or lower keep_windows in [store]",
    "ReadOnlyStore": "it is read-only; check the permissions and the mount of [store] directory",
}


def is_full(path: Path) -> bool:
    """Return whether the disk of a file has no room for one more page."""
    try:
        room = os.statvfs(path.parent)
    except OSError:
        return False
    return room.f_bavail * room.f_frsize < PAGE_BYTES


def make_store_error(path: Path, error: OSError) -> StoreError:
    """Translate an operating system's error into a StoreError (``code``: DiskFull, ReadOnlyStore, StoreFault)."""
    code = _CODES.get(error.errno or 0, "StoreFault")
    cause = CAUSES.get(code, f"{error.strerror}; check the disk, there is no retry")
    return StoreError(f"{path} could not be written: {cause}", code)


def write_file(path: Path, content: bytes, like: os.stat_result | None = None, part: Path | None = None) -> None:
    """Write ``content`` under a temporary name, fsync, rename, fsync the folder. Raises StoreError.

    ``like``: take over the mode and owner of another file.

    The temporary name is fixed (``.NAME.part``), so that leftovers of a power cut are overwritten and do not
    accumulate; ``part`` is another one if several processes may write the same file at once.
    """
    part = part or path.with_name(f".{path.name}.part")
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        try:
            if like is not None:
                os.fchown(descriptor, like.st_uid, like.st_gid)
                os.fchmod(descriptor, stat.S_IMODE(like.st_mode))
            write_all(descriptor, content)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        part.rename(path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise make_store_error(path, error) from None


def write_all(descriptor: int, content: bytes) -> None:
    """Write all of ``content``. Raises OSError."""
    view = memoryview(content)
    while view:  # a write may be short
        view = view[os.write(descriptor, view) :]


def make_folder(folder: Path) -> None:
    """Create a folder and its missing parents so that they survive a power cut. Raises OSError."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)


def keep_newest(path: Path, others: Iterable[Path], most: int) -> None:
    """Remove the oldest of ``others`` until ``most`` files remain with ``path``, the newest. Raises OSError.

    The order is that of the modification times; ``path`` gets a later one if the clock was set back.
    """
    newest = sorted(others, key=lambda file: file.stat().st_mtime_ns, reverse=True)
    last_ns = newest[0].stat().st_mtime_ns if newest else 0
    if path.stat().st_mtime_ns <= last_ns:
        os.utime(path, ns=(last_ns + 1, last_ns + 1))
    for file in newest[most - 1 :]:
        file.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make renames and removals in ``folder`` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
