"""Keeps records on a private disk that becomes full or read-only, and starts again after that.

The disk is in memory, in a name space of the process: it is invisible to others and ends with the process.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable
from pathlib import Path

from fdhil.errors import FdhilError
from tests.crash.call_faults import CommandChannel, Make, done_by, look

NEW_SPACE, NEW_USER = 0x00020000, 0x10000000
READ_ONLY, REMOUNT, PRIVATE = 1, 32, 0x4000 | (1 << 18)
DISK_BYTES = 4 << 20
RECORDS, LATER = 3, 9

_libc = ctypes.CDLL(None, use_errno=True)


def filled(make: Make, folder: Path, free_bytes: int) -> CommandChannel:
    def work(tell: Callable[..., None]) -> None:
        disk = _mounted(folder)
        _keep(make, disk, 1, tell)
        ballast = folder / "ballast"
        _fill(ballast, free_bytes)
        for number in range(2, 2 + RECORDS):
            _keep(make, disk, number, tell)
        ballast.unlink()
        look(make, disk, LATER, tell)

    return done_by(work)


def read_only(make: Make, folder: Path) -> CommandChannel:
    def work(tell: Callable[..., None]) -> None:
        disk = _mounted(folder)
        for number in (1, 2):
            _keep(make, disk, number, tell)
        _remount(folder, REMOUNT | READ_ONLY)
        _keep(make, disk, 3, tell)
        _remount(folder, REMOUNT)
        look(make, disk, LATER, tell)

    return done_by(work)


def _keep(make: Make, disk: Path, number: int, tell: Callable[..., None]) -> None:
    try:
        keeper = make(disk)
        try:
            keeper.keep(number)
        finally:
            keeper.close()
    except FdhilError as error:
        tell(refused=str(error))
    else:
        tell(kept=number)


def _mounted(folder: Path) -> Path:
    uid, gid = os.getuid(), os.getgid()
    _called(_libc.unshare(NEW_SPACE | (NEW_USER if uid else 0)))
    if uid:
        for name, text in (("setgroups", "deny"), ("uid_map", f"0 {uid} 1"), ("gid_map", f"0 {gid} 1")):
            Path(f"/proc/self/{name}").write_text(text, "ascii")
    _called(_libc.mount(b"none", b"/", None, PRIVATE, None))
    _called(_libc.mount(b"made", bytes(folder), b"tmpfs", 0, f"size={DISK_BYTES}".encode()))
    store = folder / "store"
    store.mkdir()
    return store


def _remount(folder: Path, flags: int) -> None:
    _called(_libc.mount(b"made", bytes(folder), b"tmpfs", flags, f"size={DISK_BYTES}".encode()))


def _called(result: int) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _fill(ballast: Path, free_bytes: int) -> None:
    with ballast.open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(1 << 14)):
            pass
    with ballast.open("ab", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(bytes(1 << 12)):
            pass
    os.truncate(ballast, ballast.stat().st_size - free_bytes)
