"""The guard's UNIX stream socket: JSON lines from the daemon, a few clients, none of which can block the loop."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fdhil.errors import DeviceError

SOCKET_NAME = "guard.sock"
MAX_CLIENTS = 8
MAX_LINE_BYTES = 1 << 16
MAX_QUEUE_BYTES = 1 << 18
SO_PEERCRED = getattr(socket, "SO_PEERCRED", 17)


@dataclass(slots=True, eq=False)
class Client:
    """One connection; ``heard_s`` is when it last said anything (monotonic)."""

    socket: socket.socket
    heard_s: float
    inbox: bytearray = field(default_factory=bytearray)
    outbox: bytearray = field(default_factory=bytearray)
    gone: bool = False

    def fileno(self) -> int:
        """The descriptor, for poll."""
        return self.socket.fileno()

    def read(self, now_s: float) -> list[dict[str, Any]]:
        """Return the complete requests that wait; a line that is no JSON object is answered at once."""
        try:
            chunk = self.socket.recv(1 << 16)
        except BlockingIOError:
            return []
        except OSError:
            chunk = b""
        if not chunk:
            self.gone = True
            return []
        self.heard_s = now_s
        self.inbox += chunk
        *lines, rest = bytes(self.inbox).split(b"\n")
        self.inbox = bytearray(rest)
        self.gone = len(rest) > MAX_LINE_BYTES
        return [request for line in lines if (request := self._parse(line)) is not None]

    def _parse(self, line: bytes) -> dict[str, Any] | None:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            request = None
        if isinstance(request, dict):
            return request
        self.reply({}, ok=False, code="BadRequest", text="the line is no JSON object", advice="send one per line")
        return None

    def reply(self, request: Mapping[str, Any], **answer: Any) -> None:
        """Queue an answer to ``request``, with its ``id``; a client that does not read is dropped."""
        if "id" in request:
            answer["id"] = request["id"]
        self.outbox += json.dumps(answer).encode() + b"\n"
        self.flush()

    def flush(self) -> None:
        """Send what is queued as far as it goes."""
        try:
            sent = self.socket.send(self.outbox) if self.outbox else 0
            del self.outbox[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True
        self.gone = self.gone or len(self.outbox) > MAX_QUEUE_BYTES


class Control:
    """The listening socket ``guard.sock`` (mode 0600) and its clients; DeviceError when it cannot be made."""

    def __init__(self, run_directory: Path) -> None:
        self.path = run_directory / SOCKET_NAME
        self.clients: list[Client] = []
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.path.unlink(missing_ok=True)  # the bus lock is ours already: no other guard listens here
            mask = os.umask(0o177)
            try:
                self._listener.bind(str(self.path))
            finally:
                os.umask(mask)
            self._listener.listen(MAX_CLIENTS)
        except OSError as error:
            self._listener.close()
            raise DeviceError(
                str(self.path),
                f"the control socket cannot be made ({error.strerror or error}); check the run directory",
            ) from None
        self._listener.setblocking(False)

    def fileno(self) -> int:
        """The listener's descriptor, for poll."""
        return self._listener.fileno()

    def accept(self, now_s: float) -> None:
        """Take one connection of the same user or root; others, and more than a few, are closed."""
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        credentials = connection.getsockopt(socket.SOL_SOCKET, SO_PEERCRED, 12)
        _, uid, _ = struct.unpack("3i", credentials)
        if uid not in (0, os.getuid()) or len(self.clients) >= MAX_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        self.clients.append(Client(connection, now_s))

    def drop_gone(self) -> None:
        """Close and forget the clients that have gone."""
        for client in self.clients:
            if client.gone:
                client.socket.close()
        self.clients = [client for client in self.clients if not client.gone]

    def close(self) -> None:
        """Close everything and remove the socket's file."""
        for client in self.clients:
            client.flush()
            client.socket.close()
        self._listener.close()
        with contextlib.suppress(OSError):
            self.path.unlink()
