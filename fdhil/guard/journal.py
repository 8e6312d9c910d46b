"""What the guard tells: JSON lines on stdout (the journal pipe) and systemd's notifications. It writes no file."""

from __future__ import annotations

import json
import os
import select
import socket
import time
from collections import deque
from typing import Any

KEPT_EVENTS = 32


class Journal:
    """One JSON line per event; a reader that is slow costs lines, never time: ``dropped`` counts them."""

    def __init__(self, descriptor: int = 1) -> None:
        self._descriptor = descriptor
        self._writable = select.poll()
        self._writable.register(descriptor, select.POLLOUT)
        self.recent: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)
        self.dropped = 0

    def write(self, event: str, **fields: Any) -> None:
        """Write an event with its monotonic and wall time."""
        record = {"event": event, "mono_s": round(time.monotonic(), 6), "wall_s": round(time.time(), 6), **fields}
        self.recent.append(record)
        line = json.dumps(record).encode()[: select.PIPE_BUF - 1] + b"\n"
        ready = self._writable.poll(0)
        try:
            if not ready or not ready[0][1] & select.POLLOUT:
                raise BlockingIOError
            os.write(self._descriptor, line)
        except OSError:
            self.dropped += 1


class Notifier:
    """systemd's sd_notify; does nothing outside a unit."""

    def __init__(self, address: str | None) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) if address else None
        self._watchdog_s = 0.0

    def tell(self, text: str) -> None:
        """Send one notification, such as READY=1."""
        if self._socket is None or self._address is None:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            self._socket.sendto(text.encode(), address)
        except OSError:
            self._socket.close()
            self._socket = None

    def alive(self, now_s: float) -> None:
        """Feed the unit's watchdog, twice a second."""
        if self._socket is not None and now_s - self._watchdog_s >= 0.5:
            self._watchdog_s = now_s
            self.tell("WATCHDOG=1")
