"""Keeps the operator's token: anyone who can read it (mode 0600, in the run directory) may arm. It is never logged."""

import os
import secrets
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from fdhil.errors import ConnectError, DeviceError
from fdhil.store import sync_folder, write_all

TOKEN_NAME = "token"
MAX_BYTES = 256


def get_operator_token(run_directory: Path) -> str:
    """Return the token that arming needs, created at the first start of guard or daemon. Raises DeviceError.

    A guard with a user of its own gets it from systemd (LoadCredential=token:...).
    """
    given = find_credential(TOKEN_NAME)
    if given is not None:
        return read_token(given.parent)
    make_run_directory(run_directory)
    return ensure_token(run_directory)


def find_credential(name: str) -> Path | None:
    """Return the path of a systemd credential, None if systemd provides none of that name."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return Path(folder) / name if folder and (Path(folder) / name).exists() else None


def make_run_directory(run_directory: Path) -> None:
    """Create a missing run directory (mode 0700). Raises DeviceError on failure, or if everybody may write there."""
    try:
        run_directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        text = f"cannot be created ({error.strerror}), nothing is sent; check run_directory and its permissions"
        raise DeviceError(str(run_directory), text) from None
    check_run_directory(run_directory)


def check_run_directory(run_directory: Path) -> None:
    """Raise DeviceError if everybody may write in a run directory: a foreign socket there would receive commands."""
    with suppress(FileNotFoundError):
        mode = stat.S_IMODE(run_directory.stat().st_mode)
        if mode & 0o002:
            text = f"RunDirectoryOpen: it has mode {mode:04o}, any user may put a socket there; chmod 0700 it"
            raise DeviceError(str(run_directory), text)


def ensure_token(run_directory: Path, lost: str = "") -> str:
    """Return the token of a run directory, created if there is none. Raises DeviceError if it cannot be kept secret.

    ``lost`` is the earlier token, which the guard has: it is written again. The file is complete or absent whenever
    this process ends; of two processes that create one at once, the first one's is used.
    """
    path = run_directory / TOKEN_NAME
    try:
        if not path.is_symlink() and not path.exists():
            _make_token(path, lost or secrets.token_hex(32))
    except OSError as error:
        raise DeviceError(str(path), f"cannot be written: {error.strerror}; check [store] run_directory") from None
    return read_token(run_directory)


def _make_token(path: Path, token: str) -> None:
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
    made = Path(name)
    try:
        try:
            write_all(descriptor, token.encode())
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        with suppress(FileExistsError):
            os.link(made, path)
            sync_folder(path.parent)
    finally:
        made.unlink()


def read_token(run_directory: Path) -> str:
    """Return the token. Raises ConnectError if there is none, DeviceError if others can read it."""
    path = run_directory / TOKEN_NAME
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        raise ConnectError(
            "daemon", f"has never run here ({path} is missing); start it with `fdhil run CONFIG`"
        ) from None
    except OSError as error:
        raise DeviceError(str(path), f"cannot be read: {error.strerror}; only the daemon's user may arm") from None
    try:
        mode = stat.S_IMODE(os.fstat(descriptor).st_mode)
        if mode & 0o077:
            raise DeviceError(
                str(path), f"has mode {mode:04o}, other users can read it; delete it and restart the daemon"
            )
        token = os.read(descriptor, MAX_BYTES).decode("ascii", "replace").strip()
        if not token:
            raise DeviceError(str(path), "is empty; delete it and start guard and daemon again")
        return token
    finally:
        os.close(descriptor)
