"""Says who is at the other end of a UNIX socket, by the kernel (SO_PEERCRED), and what he may ask the guard for."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

SO_PEERCRED = getattr(socket, "SO_PEERCRED", 17)


class Role(IntEnum):
    """What a user may do; each may do what those before it may."""

    NOBODY = 0
    WATCH = 1
    OPERATE = 2
    COMMISSION = 3


# what each request needs; what is not listed needs the most, and so does to vouch for a drive (compared)
NEEDS: Mapping[object, Role] = {
    "status": Role.WATCH,
    "disarm": Role.WATCH,  # standing still is never refused to one who may look
    "alive": Role.OPERATE,
    "table": Role.OPERATE,
    "arm": Role.OPERATE,
    "feedforward": Role.OPERATE,
    "adopt": Role.OPERATE,
}


@dataclass(frozen=True, slots=True)
class Access:
    """The users that may talk to the guard besides root and its own: the daemon's, and those that may watch."""

    daemon_uid: int | None = None
    watching: tuple[int, ...] = ()

    @property
    def shared(self) -> bool:
        """Whether anybody else may."""
        return self.daemon_uid is not None or bool(self.watching)

    def role_of(self, uid: int) -> Role:
        """Return what a user may do: who arms must be the daemon, which vouches for the model."""
        if uid in (0, os.getuid()):
            return Role.COMMISSION
        if uid == self.daemon_uid:
            return Role.OPERATE
        return Role.WATCH if uid in self.watching else Role.NOBODY


@dataclass(frozen=True, slots=True)
class Peer:
    """A process that talks to the guard: its user, its number, what it may do."""

    uid: int
    pid: int
    role: Role

    def may(self, request: object) -> bool:
        """Whether it may ask for that."""
        return self.role >= (NEEDS.get(request, Role.COMMISSION) if isinstance(request, str) else Role.COMMISSION)

    def refused(self, request: object) -> dict[str, str]:
        """Return why not: class, cause and next action."""
        what = repr(request[:40]) if isinstance(request, str) else "that"
        may = f"may not ask the guard for {what}" if self.role else "may not talk to the guard"
        advice = "ask the daemon for it; [access] of the configuration says who may what"
        return {"code": "AuthRequired", "text": f"user {self.uid} {may}", "advice": advice}


def credentials(connection: socket.socket) -> tuple[int, int]:
    """Return process and user at the other end."""
    pid, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, SO_PEERCRED, 12))
    return pid, uid
