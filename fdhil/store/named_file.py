"""Opens a file by a name that came from outside: never anything but a regular file of that one folder."""

import errno
import os
import re
import stat
from contextlib import suppress
from io import BufferedReader
from pathlib import Path

from fdhil.errors import StoreError

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,63}")  # what begins with a dot is being written
_NEXT = "take a name from the list"


def open_named(folder: Path, name: str) -> BufferedReader:
    """Open the regular file ``name`` of ``folder`` for reading.

    A path, a link, a device or a pipe is StoreError BadName, before anything of it is read; NotKept when there is no
    such file (any more), StoreFault when it cannot be read. Whoever puts a link in its place meanwhile gains nothing:
    the folder is held open, and what was opened is asked what it is.
    """
    if not _NAME.fullmatch(name):
        raise _bad(f"{name[:80]!a} is no name of a file of fdhil")
    try:
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            # without O_NONBLOCK a pipe would keep whoever opens it waiting
            descriptor = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=held)
        finally:
            os.close(held)
    except OSError as error:
        raise _refused(name, error) from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        with suppress(OSError):
            os.close(descriptor)
        raise _bad(f"{name} is no regular file")
    return os.fdopen(descriptor, "rb")


def _bad(what: str) -> StoreError:
    return StoreError(f"{what}, and nothing was read; {_NEXT}", "BadName")


def _refused(name: str, error: OSError) -> StoreError:
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        text = f"{name} is not kept (any more): the newest recordings push the oldest out"
        return StoreError(f"{text}; raise keep_windows in [store] to keep more", "NotKept")
    if error.errno in (errno.ELOOP, errno.ENXIO):  # a link; a socket
        return _bad(f"{name} is no regular file")
    return StoreError(f"{name} cannot be read: {error.strerror}; check the rights of the store")
