"""Writes a command's output file: completely or not at all, replacing only regular files.

The null device and the process' standard output are written to directly; the old file is kept if writing the new one
fails.
"""

import contextlib
import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from fdhil.errors import OutputError

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISBLK, "a disk"),
    (stat.S_ISCHR, "a device"),
)


def check_output(path: Path) -> None:
    """Check that ``path`` can be written, before the work is done. Raises OutputError if it cannot."""
    try:
        status = path.stat()
    except FileNotFoundError:
        _check_folder(path)
        return
    except (OSError, ValueError) as error:
        raise _make_output_error(path, error) from None
    if _is_stream(status):
        return
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(status.st_mode)), "no file")
        raise OutputError(f"{path} is {kind}, which is never replaced: nothing was written; name a file")
    if not os.access(path, os.W_OK):
        raise OutputError(f"{path} is read-only and was left unchanged; check its permissions or name another file")
    _check_folder(path)


@contextlib.contextmanager
def open_output(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file for bytes, which gets the name ``path`` when it is complete. Raises OutputError on failure."""
    check_output(path)
    try:
        if path.exists() and _is_stream(path.stat()):
            with _open_stream(path) as stream:
                yield stream
            return
        target = path.resolve()
        part = target.with_name(f".{target.name}.{os.getpid()}.part")
        try:
            with part.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            if target.exists():
                part.chmod(stat.S_IMODE(target.stat().st_mode))
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise _make_output_error(path, error) from None


def _is_stream(status: os.stat_result) -> bool:
    if stat.S_ISCHR(status.st_mode) and status.st_rdev == Path(os.devnull).stat().st_rdev:
        return True
    return _find_standard_stream(status) is not None


def _find_standard_stream(status: os.stat_result) -> int | None:
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if os.path.samestat(status, os.fstat(descriptor)):
                return descriptor
    return None


def _open_stream(path: Path) -> IO[bytes]:
    """Open the null device, or a standard stream at its position: reopening would truncate a file behind it."""
    descriptor = _find_standard_stream(path.stat())
    if descriptor is None:
        return path.open("wb")
    sys.stdout.flush()
    return os.fdopen(os.dup(descriptor), "wb")


def _check_folder(path: Path) -> None:
    folder = path.resolve().parent
    if not folder.is_dir():
        raise OutputError(
            f"{path} cannot be written: the folder {folder} does not exist; create it, or name another file"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{path} cannot be written: the folder {folder} is read-only; name another file")


def _make_output_error(path: Path, error: OSError | ValueError) -> OutputError:
    reason = getattr(error, "strerror", None) or error
    return OutputError(f"{path} cannot be written ({reason}), an existing file is unchanged; name another file")
