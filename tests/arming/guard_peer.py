"""A peer that listens at the guard's socket in place of the guard."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

ZERO: Mapping[str, Any] = {"X": 0.0, "Y": 0.0}
FINE: Mapping[str, Any] = {"state": "ACTIVE", "cause": None, "ok": True, "may_stand_um": ZERO}
Says = Callable[[str], Mapping[str, Any] | None]


class GuardPeer:
    """Answers requests by ``says``; None: no answer. ``descriptor`` came with the current request."""

    def __init__(self, folder: Path) -> None:
        self.says: Says = lambda _kind: FINE
        self.heard: list[str] = []
        self.requests: list[Mapping[str, Any]] = []
        self.descriptor: int | None = None
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(folder / "guard.sock"))
        self._listener.listen()
        self._threads: list[threading.Thread] = []
        self._peers: list[socket.socket] = []
        self._open_socket(self._accept_client)

    def _open_socket(self, what: Callable[..., None], *values: Any) -> None:
        self._threads.append(threading.Thread(target=what, args=values, daemon=True))
        self._threads[-1].start()

    def _accept_client(self) -> None:
        while True:
            try:
                peer, _ = self._listener.accept()
            except OSError:
                return
            self._peers.append(peer)
            self._open_socket(self._serve_client, peer)

    def _serve_client(self, peer: socket.socket) -> None:
        with contextlib.suppress(ConnectionError), peer:
            inbox = b""
            while chunk := self._receive_line(peer):
                *lines, inbox = (inbox + chunk).split(b"\n")
                for line in lines:
                    self._take_request(peer, json.loads(line))
                self._drop_client()

    def _receive_line(self, peer: socket.socket) -> bytes:
        chunk, descriptors, _, _ = socket.recv_fds(peer, 1 << 16, 1)
        if descriptors:
            self.descriptor = descriptors[0]
        return chunk

    def _drop_client(self) -> None:
        if self.descriptor is not None:
            os.close(self.descriptor)
            self.descriptor = None

    def _take_request(self, peer: socket.socket, request: Mapping[str, Any]) -> None:
        self.heard.append(request["request"])
        self.requests.append(request)
        answer = self.says(request["request"]) if "id" in request else None
        if answer is not None:
            peer.sendall(json.dumps({**answer, "id": request["id"]}).encode() + b"\n")

    def close(self) -> None:
        for each in (self._listener, *self._peers):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(10.0)
