"""Opens a file by a name from outside: only a regular file of one given folder."""

import errno
import os
import re
import stat
from contextlib import suppress
from io import BufferedReader
from pathlib import Path

from fdhil.errors import StoreError

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # files being written begin with a dot
_NEXT = "use a name from the list"


def open_named(folder: Path, name: str) -> BufferedReader:
    """Open the regular file ``name`` of ``folder`` for reading.

    A path, link, device or pipe raises StoreError BadName before any of it is read; NotKept if there is no such file
    (any more), StoreFault if it cannot be read. The folder is held open and the opened file is examined, so that
    replacing it by a link in between has no effect.
    """
    if not _NAME.fullmatch(name):
        raise _make_bad_name_error(f"{name[:80]!a} is not a file name of fdhil")
    try:
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            # without O_NONBLOCK opening a pipe would block
            descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=held)
        finally:
            os.close(held)
    except OSError as error:
        raise _make_open_error(name, error) from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        with suppress(OSError):
            os.close(descriptor)
        raise _make_bad_name_error(f"{name} is not a regular file")
    return os.fdopen(descriptor, "rb")


def _make_bad_name_error(what: str) -> StoreError:
    return StoreError(f"{what}, and nothing was read; {_NEXT}", "BadName")


def _make_open_error(name: str, error: OSError) -> StoreError:
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        text = f"{name} is not stored (any more): the newest recordings displace the oldest"
        return StoreError(f"{text}; raise keep_windows in [store] to keep more", "NotKept")
    if error.errno in (errno.ELOOP, errno.ENXIO):  # a link; a socket
        return _make_bad_name_error(f"{name} is not a regular file")
    return StoreError(f"{name} cannot be read: {error.strerror}; check the permissions of the store")
