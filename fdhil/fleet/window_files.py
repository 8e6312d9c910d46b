"""Stores the recorded windows of many machines: one file each, named by its SHA-256, never changed."""

import os
import secrets
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.store import make_folder, make_store_error, write_file


def build_window_path(folder: Path, name: str) -> Path:
    return folder / name[:2] / f"{name}.parquet"


def store_window(folder: Path, name: str, window: bytes) -> None:
    """Write a window durably, once; concurrent writers of the same window are safe. StoreError."""
    path = build_window_path(folder, name)
    try:
        os.utime(path)  # mark as used: the removal of unreferenced windows skips it
        return
    except FileNotFoundError:
        pass
    except OSError as error:
        raise make_store_error(path, error) from None
    try:
        make_folder(path.parent)
    except OSError as error:
        raise make_store_error(path, error) from None
    # a unique temporary name: no byte of another collector's partial file may get the final name. A file left by a
    # killed collector is removed as an unreferenced window
    write_file(path, window, part=build_window_path(folder, f"{name}-{secrets.token_hex(8)}"))


def check_folder(folder: Path) -> None:
    """Create the folder; StoreError where it cannot be written."""
    try:
        make_folder(folder)
        write_file(folder / ".writable", b"")
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be created: {error.strerror}; no records are collected. Check [objects] directory"
        ) from None
