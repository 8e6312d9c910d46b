"""Examines the store and its secrets: folders, permissions, free space, history, records, token."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from fdhil.arming import TOKEN_NAME, check_run_directory, read_token
from fdhil.cli.doctor.trouble import Trouble
from fdhil.commissioning import is_record_void, load_record
from fdhil.config import MachineConfig
from fdhil.errors import DeviceError, StoreError
from fdhil.guard import SOCKET_NAME
from fdhil.store import History

LEAST_FREE_BYTES = 256 << 20
WINDOW_BYTES = 100_000  # approximate size of one recorded rapid
LONGEST_SOCKET_PATH = 107  # sun_path without its closing zero
RECORD_BAD = "RecordBad"
COMMISSION = "run `fdhil commission`"


def examine_store(config: MachineConfig) -> Iterator[Trouble]:
    """Examine folder, permissions, disk and history of the store."""
    folder = config.store.directory
    base = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    means = "measurements are not stored, and nothing can be armed"
    if not base.is_dir():
        what, mend = f"{base} is a file; [store] needs a folder", "move it away or correct [store] directory"
        yield Trouble("StoreNoFolder", "store", what, means, mend)
        return
    if not can_write(base):
        mend = (
            f"give this user ({os.environ.get('USER') or os.getuid()}) write permission, or correct [store] directory"
        )
        yield Trouble("StoreReadOnly", "store", f"{base} is not writable", means, mend)
    free = shutil.disk_usage(base).free
    if free < LEAST_FREE_BYTES:
        what = f"{free / 1e6:.0f} MB are free on the disk of {base}, enough for {free // WINDOW_BYTES} rapids"
        yield Trouble("DiskFull", "store", what, means, "free space, or lower keep_windows in [store]")
    yield from _examine_history(folder)


def can_write(folder: Path) -> bool:
    """Return whether this user can create files in a folder."""
    return os.access(folder, os.W_OK | os.X_OK)


def _examine_history(folder: Path) -> Iterator[Trouble]:
    try:
        with History.open_read_only(folder):
            pass
    except StoreError as error:
        if error.code != "NoHistory":
            yield Trouble.create_from_error(error.code, "store", error, "earlier parameters are unavailable")


def examine_secrets(config: MachineConfig) -> Iterator[Trouble]:
    """Examine sockets, token and records: presence and permissions."""
    for folder in dict.fromkeys((config.run_directory, config.guard_directory)):
        yield from _examine_run_directory(folder)
    if (config.run_directory / TOKEN_NAME).is_symlink() or (config.run_directory / TOKEN_NAME).exists():
        try:
            read_token(config.run_directory)
        except DeviceError as error:
            yield Trouble.create_from_error("TokenOpen", "token", error, "nothing can be armed")
    for name, axis in config.axis.items():
        if axis.correction is not None:
            yield from _examine_record(config, name)


def _examine_run_directory(folder: Path) -> Iterator[Trouble]:
    path = str((folder / SOCKET_NAME).absolute())
    if len(os.fsencode(path)) > LONGEST_SOCKET_PATH:
        what = f"{path} is too long for a socket ({len(path)} characters, at most {LONGEST_SOCKET_PATH})"
        mend = "choose a shorter [store] run_directory, such as /run/fdhil"
        yield Trouble("SocketPathLong", "sockets", what, "neither daemon nor guard can be contacted", mend)
    try:
        check_run_directory(folder)
    except DeviceError as error:
        yield Trouble.create_from_error("RunDirectoryOpen", "sockets", error, "commands may reach a foreign program")
    except OSError:
        pass  # unreadable; programs that use it report the reason


def _examine_record(config: MachineConfig, axis: str) -> Iterator[Trouble]:
    place, means = f"axis {axis}", "nothing can be armed there"
    directory = config.store.directory
    try:
        record = load_record(directory, axis, config.store.commissioning_key, may_lack_key=True)
    except StoreError as error:
        yield Trouble.create_from_error(RECORD_BAD, place, error, means)
        return
    if record is None:
        mend = f"{COMMISSION} with the NC off and the axis free to move"
        yield Trouble("NotCommissioned", place, "it has [correction], but is not commissioned", means, mend, False)
    elif is_record_void(directory, axis):
        what = "its commissioning record became doubtful"
        yield Trouble("RecordVoid", place, what, means, "run `fdhil check` with the NC off, which compares the drive")
