"""The file that a command was asked to write: there whole or not at all, and never in place of what is no regular file.

The null device and what the process has as standard output are written to as they are; the old file is kept where
writing the new one fails.
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
    """Look whether ``path`` may be written, before the work that it is for; OutputError when it may not."""
    try:
        told = path.stat()
    except FileNotFoundError:
        _check_folder(path)
        return
    except (OSError, ValueError) as error:
        raise _not_written(path, error) from None
    if _is_stream(told):
        return
    if not stat.S_ISREG(told.st_mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(told.st_mode)), "no file")
        raise OutputError(f"{path} is {kind}, which is never replaced, and nothing was written; name a file")
    if not os.access(path, os.W_OK):
        raise OutputError(f"{path} may not be written, and it is left as it is; check its rights or name another file")
    _check_folder(path)


@contextlib.contextmanager
def open_output(path: Path) -> Iterator[IO[bytes]]:
    """Yield a file to write bytes to, which gets the name ``path`` when all is written. OutputError when it cannot."""
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
        raise _not_written(path, error) from None


def _is_stream(told: os.stat_result) -> bool:
    if stat.S_ISCHR(told.st_mode) and told.st_rdev == Path(os.devnull).stat().st_rdev:
        return True
    return _descriptor(told) is not None


def _descriptor(told: os.stat_result) -> int | None:
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            if os.path.samestat(told, os.fstat(descriptor)):
                return descriptor
    return None


def _open_stream(path: Path) -> IO[bytes]:
    descriptor = _descriptor(path.stat())
    if descriptor is None:
        return path.open("wb")
    sys.stdout.flush()
    return os.fdopen(os.dup(descriptor), "wb")


def _check_folder(path: Path) -> None:
    folder = path.resolve().parent
    if not folder.is_dir():
        raise OutputError(f"{path} cannot be written: there is no folder {folder}; make it, or name another file")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{path} cannot be written: the folder {folder} may not be written; name another file")


def _not_written(path: Path, error: OSError | ValueError) -> OutputError:
    reason = getattr(error, "strerror", None) or error
    return OutputError(f"{path} cannot be written ({reason}), and what was there is kept; name another file")
