"""Identifies the process at the other end of a UNIX socket (SO_PEERCRED) and its rights."""

import contextlib
import os
import pwd
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fdhil.config import Access
from fdhil.guard import Role, read_peer_credentials

# rights that each request needs; any other needs the highest
NEEDS: Mapping[str, Role] = {
    "status": Role.WATCH,
    "live": Role.WATCH,
    "disarm": Role.WATCH,  # never refused to a user who may watch
    "arm": Role.OPERATE,
    "acknowledge": Role.OPERATE,
}


@dataclass(frozen=True, slots=True)
class ClientProcess:
    """A client process of the daemon: its user, its process ID, its rights."""

    user: str
    uid: int
    pid: int
    role: Role

    def may_request(self, request: str) -> bool:
        """Return whether it may make this request."""
        return self.role >= NEEDS.get(request, Role.COMMISSION)


def identify_peer(connection: socket.socket, access: Access) -> ClientProcess:
    """Return the client at the other end: the daemon's user and root have all rights, others those of the config."""
    pid, uid = read_peer_credentials(connection)
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError:
        user = str(uid)
    return ClientProcess(user, uid, pid, get_role(user, uid, access))


def get_role(user: str, uid: int, access: Access) -> Role:
    """Return the rights of a user of this computer; the daemon's user and root have all."""
    if uid in (0, os.getuid()):
        return Role.COMMISSION
    if user in access.operate:
        return Role.OPERATE
    return Role.WATCH if user in access.watch else Role.NOBODY


def open_listener(path: Path, access: Access) -> socket.socket:
    """Open a listening socket at ``path``: for its owner (0600), and its group (0660) where ``access`` names users.

    Then the group may also enter the folder, but not list it: the token in it stays the owner's. A socket file left by
    a crash is replaced. OSError when it cannot be created.
    """
    with contextlib.suppress(FileNotFoundError):
        if path.is_socket():
            path.unlink()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(str(path))
        shared = bool(access.watch or access.operate)
        path.chmod(0o660 if shared else 0o600)
        if shared:
            with contextlib.suppress(PermissionError):  # another owner's folder stays as it is
                path.parent.chmod(path.parent.stat().st_mode & 0o7777 | 0o010)
    except OSError:
        listener.close()
        raise
    return listener
