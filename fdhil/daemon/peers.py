"""Says who is at the other end of a UNIX socket, by the kernel's word (SO_PEERCRED), and what he may ask for."""

from __future__ import annotations

import contextlib
import os
import pwd
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fdhil.config import Access
from fdhil.guard.peers import Role, credentials

# what each request needs; what is not listed needs the most
NEEDS: Mapping[str, Role] = {
    "status": Role.WATCH,
    "live": Role.WATCH,
    "disarm": Role.WATCH,  # standing still is never refused to one who may look
    "arm": Role.OPERATE,
    "acknowledge": Role.OPERATE,
}


@dataclass(frozen=True, slots=True)
class Peer:
    """A process that talks to the daemon: its user, its number, what it may do."""

    user: str
    uid: int
    pid: int
    role: Role

    def may(self, request: str) -> bool:
        """Whether it may ask for that."""
        return self.role >= NEEDS.get(request, Role.COMMISSION)


def peer_of(connection: socket.socket, access: Access) -> Peer:
    """Return who is at the other end: the daemon's own user and root may do all, others what the config says."""
    pid, uid = credentials(connection)
    try:
        user = pwd.getpwuid(uid).pw_name
    except KeyError:
        user = str(uid)
    return Peer(user, uid, pid, role_of(user, uid, access))


def role_of(user: str, uid: int, access: Access) -> Role:
    """Return what a user of this computer may do; the daemon's own and root may do all."""
    if uid in (0, os.getuid()):
        return Role.COMMISSION
    if user in access.operate:
        return Role.OPERATE
    return Role.WATCH if user in access.watch else Role.NOBODY


def listen(path: Path, access: Access) -> socket.socket:
    """Return a listening socket at ``path``: the owner's alone (0600), its group's too where ``access`` names users.

    Then the group may also enter the folder, but not list it: the token there stays the owner's. A socket file left by
    a crash is replaced. OSError when it cannot be made.
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
            with contextlib.suppress(PermissionError):  # a folder of another owner is as that one wants it
                path.parent.chmod(path.parent.stat().st_mode & 0o7777 | 0o010)
    except OSError:
        listener.close()
        raise
    return listener
