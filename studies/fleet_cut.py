"""A network that can be cut: data between its two ends is dropped, and neither end is notified."""

from __future__ import annotations

import contextlib
import socket
import threading


class Network:
    """Carries each connection to ``port`` of this computer to another; while it is ``cut`` all is dropped."""

    def __init__(self, to_port: int) -> None:
        self.cut = False
        self._to_port = to_port
        self._door = socket.create_server(("127.0.0.1", 0))
        self.port = self._door.getsockname()[1]
        threading.Thread(target=self._answer, daemon=True).start()

    def close(self) -> None:
        """Stop accepting connections."""
        self._door.shutdown(socket.SHUT_RDWR)  # wakes who waits at it
        self._door.close()

    def _answer(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._door.accept()
                threading.Thread(target=self._connect, args=(near,), daemon=True).start()

    def _connect(self, near: socket.socket) -> None:
        if self.cut:  # it is accepted by this computer, and nobody ever speaks
            self._carry(near, None)
            return
        with contextlib.suppress(OSError):
            far = socket.create_connection(("127.0.0.1", self._to_port))
            threading.Thread(target=self._carry, args=(far, near), daemon=True).start()
            self._carry(near, far)

    def _carry(self, source: socket.socket, target: socket.socket | None) -> None:
        """Carry one direction until an end is closed; what was dropped once ends it, as TCP would."""
        whole = target is not None
        with contextlib.suppress(OSError), source:
            while data := source.recv(1 << 16):
                whole = whole and not self.cut
                if whole and target is not None:
                    target.sendall(data)
        if whole and target is not None:
            with contextlib.suppress(OSError):
                target.close()
