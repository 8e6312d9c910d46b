"""The recorded windows of many machines: one file each, named by the SHA-256 of its content, never changed."""

import os
import secrets
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.store.atomic import make_folder, store_error, write_file


def path_of(folder: Path, name: str) -> Path:
    """Return where the window of that name is."""
    return folder / name[:2] / f"{name}.parquet"


def keep(folder: Path, name: str, window: bytes) -> None:
    """Write a window durably, once; a second writer of the same does no harm. StoreError."""
    path = path_of(folder, name)
    try:
        os.utime(path)  # it is named anew: whoever removes what no row names leaves it alone
        return
    except FileNotFoundError:
        pass
    except OSError as error:
        raise store_error(path, error) from None
    try:
        make_folder(path.parent)
    except OSError as error:
        raise store_error(path, error) from None
    # of another collector's half file no byte may come under the name; one that a kill leaves behind goes as a window
    # that no row names
    write_file(path, window, part=path_of(folder, f"{name}-{secrets.token_hex(8)}"))


def check_folder(folder: Path) -> None:
    """Make the folder; StoreError where it cannot be written."""
    try:
        make_folder(folder)
        write_file(folder / ".writable", b"")
    except OSError as error:
        raise StoreError(f"{folder} cannot be made: {error.strerror}; check [objects] directory") from None
