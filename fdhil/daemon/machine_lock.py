"""Locks a machine for one daemon; the kernel releases the lock with the process, however it ends."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from fdhil.errors import DeviceError

LOCK_NAME = "daemon.lock"


class BusLocked(DeviceError):
    """Another daemon already serves this configuration."""


@contextmanager
def lock_machine(run_directory: Path, store_directory: Path) -> Iterator[None]:
    """Hold the locks of a run directory (created with mode 0700 if missing) and of a store.

    BusLocked when another process holds one of them. The store has its own lock, because removing the run directory of
    a daemon does not end it. A missing or unreadable store is reported when it is opened.
    """
    with ExitStack() as held:
        try:
            run_directory.mkdir(parents=True, exist_ok=True, mode=0o700)
            descriptor = os.open(
                run_directory / LOCK_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600
            )
            held.callback(os.close, descriptor)
            free = _try_lock(descriptor)
        except OSError as error:
            text = f"cannot be used: {error.strerror}; check [store] run_directory and its permissions"
            raise DeviceError(str(run_directory), text) from None
        if not free:
            owner = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip() or "unknown"
            text = f"BusLocked: a daemon already serves it (process {owner}), nothing was sent; stop that daemon first"
            raise BusLocked(str(run_directory), text)
        with suppress(OSError):
            store_directory.mkdir(parents=True, exist_ok=True)
            store = os.open(store_directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            held.callback(os.close, store)
            if not _try_lock(store):
                text = "BusLocked: another daemon writes to this store, nothing was sent; stop that daemon first"
                raise BusLocked(str(store_directory), text)
        with suppress(OSError):  # only for the message of a second daemon; the lock holds without it
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        yield


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
