"""Keeps the operator's token: who can read it (mode 0600, in the run directory) may arm. It is never logged."""

import os
import secrets
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from fdhil.errors import ConnectError, DeviceError
from fdhil.store.atomic import sync_folder, write_all

TOKEN_NAME = "token"
MAX_BYTES = 256


def operator_token(run_directory: Path) -> str:
    """Return the token that arming needs, made at the first start of guard or daemon. DeviceError.

    Under a user of its own the guard is given it by systemd (LoadCredential=token:...).
    """
    given = given_credential(TOKEN_NAME)
    if given is not None:
        return read_token(given.parent)
    make_directory(run_directory)
    return ensure_token(run_directory)


def given_credential(name: str) -> Path | None:
    """Return the credential of that name, None where systemd gives none."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    return Path(folder) / name if folder and (Path(folder) / name).exists() else None


def make_directory(run_directory: Path) -> None:
    """Make a run directory (mode 0700) where there is none; DeviceError when that fails, or anybody may write there."""
    try:
        run_directory.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        text = f"cannot be made ({error.strerror}), and nothing is sent; check run_directory and its rights"
        raise DeviceError(str(run_directory), text) from None
    check_rights(run_directory)


def check_rights(run_directory: Path) -> None:
    """Raise DeviceError when anybody may write in a run directory: commands would reach whoever put a socket there."""
    with suppress(FileNotFoundError):
        mode = stat.S_IMODE(run_directory.stat().st_mode)
        if mode & 0o002:
            text = f"RunDirectoryOpen: it has mode {mode:04o}, anybody may put a socket of his own there; chmod 0700 it"
            raise DeviceError(str(run_directory), text)


def ensure_token(run_directory: Path, lost: str = "") -> str:
    """Return the token of a run directory; make one where there is none. DeviceError when it cannot be kept secret.

    ``lost`` is the token that was there, which the guard knows: it is written again.
    It is there whole or not at all, whatever ends this process; of two who make one at once the first one's is taken.
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
    """Return the token. ConnectError when there is none, DeviceError when others can read it."""
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
                str(path), f"has mode {mode:04o}, others can read it; delete it and start the daemon again"
            )
        token = os.read(descriptor, MAX_BYTES).decode("ascii", "replace").strip()
        if not token:
            raise DeviceError(str(path), "is empty; delete it and start guard and daemon again")
        return token
    finally:
        os.close(descriptor)
