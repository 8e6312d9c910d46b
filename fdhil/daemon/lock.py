"""Locks a machine for one daemon; the kernel releases the lock with the process, however that ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fdhil.errors import DeviceError

LOCK_NAME = "daemon.lock"


class BusLocked(DeviceError):
    """Another daemon already serves this configuration."""


@contextmanager
def sole_owner(run_directory: Path) -> Iterator[None]:
    """Hold the lock of a run directory (made with mode 0700 where it is missing). BusLocked when another holds it."""
    try:
        run_directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        descriptor = os.open(run_directory / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        text = f"cannot be used: {error.strerror}; check [store] run_directory and its rights"
        raise DeviceError(str(run_directory), text) from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip() or "unknown"
            text = f"BusLocked: a daemon already serves it (process {owner}); stop that one first, nothing was sent"
            raise BusLocked(str(run_directory), text) from None
        with contextlib.suppress(OSError):  # it is only told to another one; the lock holds without it
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)
