"""Writes events as JSON lines to stdout (the journal pipe) and notifies systemd. It writes no file."""

import json
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

KEPT_EVENTS = 32
WATCHDOG = "WATCHDOG=1"
MOST_CHARACTERS = 500  # per text, so that the pipe takes a line at once


class Clock(NamedTuple):
    """The guard's monotonic and wall clock, and the poll object that it waits with."""

    now_s: Callable[[], float] = time.monotonic
    wall_s: Callable[[], float] = time.time
    new_poll: Callable[[], select.poll] = select.poll


SYSTEM = Clock()


class EventJournal:
    """Writes one JSON line per event, dated by ``clock``; a slow reader loses lines (``dropped``), never delays us."""

    def __init__(self, descriptor: int = 1, clock: Clock = SYSTEM) -> None:
        self._descriptor, self.clock = descriptor, clock
        self._writable = select.poll()
        self._writable.register(descriptor, select.POLLOUT)
        self.recent: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)
        self.dropped = 0

    def write(self, event: str, **fields: Any) -> None:
        """Write an event with its monotonic and wall time."""
        stamps = {"mono_s": round(self.clock.now_s(), 6), "wall_s": round(self.clock.wall_s(), 6)}
        short = {key: value[:MOST_CHARACTERS] if isinstance(value, str) else value for key, value in fields.items()}
        record = {"event": event, **stamps, **short}
        self.recent.append(record)
        line = json.dumps(record).encode()[: select.PIPE_BUF - 1] + b"\n"
        ready = self._writable.poll(0)
        try:
            if not ready or not ready[0][1] & select.POLLOUT:
                raise BlockingIOError
            os.write(self._descriptor, line)
        except OSError:
            self.dropped += 1


class SystemdNotifier:
    """systemd's sd_notify; does nothing outside a unit. What cannot be sent now is sent with the next watchdog."""

    def __init__(self, address: str | None) -> None:
        self._address = None if address is None else "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self._pending: deque[str] = deque(maxlen=4)
        self._watchdog_s = 0.0

    def notify_systemd(self, text: str) -> None:
        """Send one notification, such as READY=1."""
        if self._address is not None:
            self._pending.append(text)
            self._send_pending()

    def feed_watchdog(self, now_s: float) -> None:
        """Feed the unit's watchdog, twice a second."""
        if now_s - self._watchdog_s >= 0.5:
            self._watchdog_s = now_s
            self._pending = deque([text for text in self._pending if text != WATCHDOG], maxlen=4)
            self.notify_systemd(WATCHDOG)

    def close(self) -> None:
        """Close the socket."""
        self._address = None
        self._socket.close()

    def _send_pending(self) -> None:
        try:
            while self._pending:
                self._socket.sendto(self._pending[0].encode("utf-8", "replace"), str(self._address))
                self._pending.popleft()
        except OSError:  # its queue is full, or systemd restarts: the rest waits
            return
