"""The users file: names, roles and scrypt hashes of passwords.

Parameters of scrypt: N = 2^15, r = 8, p = 1 (32 MiB, about 0.1 s), after RFC 7914 and OWASP's password storage cheat
sheet. The file is written atomically and is readable by its owner and group only.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import logging
import os
import secrets
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

from fdhil.errors import ConfigError, ConfigFault

Role = Literal["watch", "operate"]
COST, BLOCK, LANES = 2**15, 8, 1
SCRYPT_BYTES = 64 * 1024 * 1024
SHORTEST_PASSWORD, LONGEST_PASSWORD = 10, 200
MAX_FILE = 256 * 1024
USER_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._@-]{0,63}$"
UserName = Annotated[str, StringConstraints(pattern=USER_NAME_PATTERN)]


class User(BaseModel):
    """One user: the role, and the hash of the password with its salt, both base64."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    role: Role
    salt: str = Field(min_length=8, max_length=100)
    scrypt: str = Field(min_length=40, max_length=100)


class Users(BaseModel):
    """The content of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    users: Mapping[UserName, User] = {}


def hash_password(password: str, role: Role) -> User:
    """Return a user with this password, under a new salt."""
    salt = secrets.token_bytes(16)
    return User(role=role, salt=_encode_base64(salt), scrypt=_encode_base64(_compute_scrypt(password, salt)))


NOBODY = User(role="watch", salt=base64.b64encode(bytes(16)).decode(), scrypt=base64.b64encode(bytes(32)).decode())
"""Stands for an unknown user, so that a wrong name takes as long as a wrong password."""


def verify_password(user: User | None, password: str) -> bool:
    """Return whether the password is the user's (blocking, 0.1 s whatever the answer)."""
    against = user or NOBODY
    found = _compute_scrypt(password, base64.b64decode(against.salt))
    return hmac.compare_digest(found, base64.b64decode(against.scrypt)) and user is not None


def read_users(path: Path) -> Mapping[str, User]:
    """Read the users file; ConfigError where it is unreadable, invalid, or open to others."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise _make_file_error(
            path, f"cannot be read: {error.strerror}", "create it with fdhil web-user CONFIG NAME"
        ) from None
    with os.fdopen(descriptor, "rb") as file:
        if stat.S_IMODE(os.fstat(descriptor).st_mode) & 0o007:
            raise _make_file_error(path, "is open to every user of this computer", f"chmod 0640 {path}")
        raw = file.read(MAX_FILE + 1)
    try:
        return Users.model_validate_json(raw).users
    except ValidationError:  # its message would show the content of the file
        raise _make_file_error(
            path, "is not a users file", "move it away, then create it again with fdhil web-user CONFIG NAME"
        ) from None


class UsersFile:
    """A users file that is read again when it changes, so that a removed user loses access at once."""

    def __init__(self, path: Path) -> None:
        """Read the file, so that a faulty one is reported at the start; ConfigError."""
        self._path = path
        self._read: tuple[tuple[int, ...], Mapping[str, User]] = ((), {})
        self._reload_users()

    def _reload_users(self) -> Mapping[str, User]:
        try:
            found = self._path.stat()
            stamp: tuple[int, ...] = (found.st_ino, found.st_mtime_ns, found.st_size, found.st_mode)
        except OSError:
            stamp = ()
        if not stamp or stamp != self._read[0]:
            self._read = stamp, read_users(self._path)
        return self._read[1]

    def find_user(self, name: str) -> User | None:
        """Return a user; None for an unknown one, or when the file can no longer be read."""
        try:
            return self._reload_users().get(name)
        except ConfigError as error:
            logging.getLogger("fdhil").error("no user can log in: %s", error)
            return None


def write_users(path: Path, users: Mapping[str, User]) -> None:
    """Replace the file atomically, with its former mode and owner, or 0600; OSError."""
    text = json.dumps({"users": {name: user.model_dump() for name, user in users.items()}}, indent=1) + "\n"
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        with os.fdopen(descriptor, "w") as file:
            if path.exists():
                before = path.stat()
                os.fchmod(descriptor, stat.S_IMODE(before.st_mode) & 0o660)
                if (before.st_uid, before.st_gid) != (os.getuid(), os.getgid()):
                    os.fchown(descriptor, before.st_uid, before.st_gid)
            file.write(text)
            file.flush()
            os.fsync(descriptor)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


def _compute_scrypt(password: str, salt: bytes) -> bytes:
    return hashlib.scrypt(password.encode(), salt=salt, n=COST, r=BLOCK, p=LANES, maxmem=SCRYPT_BYTES, dklen=32)


def _encode_base64(raw: bytes) -> str:
    return base64.b64encode(raw).decode()


def _make_file_error(path: Path, what: str, suggestion: str) -> ConfigError:
    return ConfigError("web.users_file", [ConfigFault(str(path), what, suggestion)])
