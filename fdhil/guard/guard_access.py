"""Identifies the process at the other end of a UNIX socket (SO_PEERCRED) and what it may request from the guard."""

import os
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

SO_PEERCRED = getattr(socket, "SO_PEERCRED", 17)


class Role(IntEnum):
    """Rights of a user; each includes those before it."""

    NOBODY = 0
    WATCH = 1
    OPERATE = 2
    COMMISSION = 3


# rights that each request needs; any other, such as compared, needs the highest
NEEDS: Mapping[object, Role] = {
    "status": Role.WATCH,
    "disarm": Role.WATCH,  # never refused to a user who may watch
    "alive": Role.OPERATE,
    "table": Role.OPERATE,
    "arm": Role.OPERATE,
    "feedforward": Role.OPERATE,
    "adopt": Role.OPERATE,
}


@dataclass(frozen=True, slots=True)
class GuardAccess:
    """Users that may use the guard besides root and its own: the daemon's, and those that may watch."""

    daemon_uid: int | None = None
    watching: tuple[int, ...] = ()

    @property
    def shared(self) -> bool:
        """Whether other users have access."""
        return self.daemon_uid is not None or bool(self.watching)

    def get_role(self, uid: int) -> Role:
        """Return the rights of a user: only the daemon, which attests the model, may arm."""
        if uid in (0, os.getuid()):
            return Role.COMMISSION
        if uid == self.daemon_uid:
            return Role.OPERATE
        return Role.WATCH if uid in self.watching else Role.NOBODY


@dataclass(frozen=True, slots=True)
class ClientProcess:
    """A client process of the guard: its user, its process ID, its rights."""

    uid: int
    pid: int
    role: Role

    def may_request(self, request: object) -> bool:
        """Return whether it may make this request."""
        return self.role >= (NEEDS.get(request, Role.COMMISSION) if isinstance(request, str) else Role.COMMISSION)

    def describe_refusal(self, request: object) -> dict[str, str]:
        """Return the refusal: class, cause and next action."""
        what = repr(request[:40]) if isinstance(request, str) else "this"
        may = f"may not request {what} from the guard" if self.role else "has no access to the guard"
        advice = "use the daemon instead; [access] of the configuration assigns the rights"
        return {"code": "AuthRequired", "text": f"user {self.uid} {may}", "advice": advice}


def read_peer_credentials(connection: socket.socket) -> tuple[int, int]:
    """Return process ID and user ID of the other end."""
    pid, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, SO_PEERCRED, 12))
    return pid, uid
