"""Limits connections, so that clients that only hold them cannot keep an operator from disarming.

An idle connection is closed; when there are too many, the longest idle one of the address with the most makes room. The
number is the server's ``limit_concurrency``: beyond it, the server would refuse new clients.
"""

import asyncio
from collections import Counter
from collections.abc import Sequence
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

MOST_CONNECTIONS = 256
QUIET_S = 20.0
"""Time, at most twice as long, in which a request must be complete and an answer be read."""


class BoundedHttpProtocol(H11Protocol):
    """An HTTP connection that is closed when idle."""

    _look: asyncio.TimerHandle
    _seen = (-1, 0)
    _answers = 0
    since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, and close another one when there are too many."""
        super().connection_made(transport)
        self.since_s = self.loop.time()
        self._look = self.loop.call_later(QUIET_S, self._abort_if_stalled)
        if self.limit_concurrency is not None and len(self.connections) >= self.limit_concurrency:
            _abort_longest_idle([each for each in self.connections if isinstance(each, Bounded) and each is not self])

    @property
    def is_idle(self) -> bool:
        """Whether it has no request in progress."""
        return self.cycle is None or self.cycle.response_complete  # type: ignore[redundant-expr]  # none came yet

    def _abort_if_stalled(self) -> None:
        unread = self.transport.get_write_buffer_size()
        before, self._seen = self._seen, (self._answers, unread)
        if before == self._seen and (self.is_idle or unread):
            self.transport.abort()
        else:
            self._look = self.loop.call_later(QUIET_S, self._abort_if_stalled)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self._answers += 1
        self.since_s = self.loop.time()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Pass the connection on to the WebSocket protocol, which has its own pings."""
        self._look.cancel()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop watching a closed connection."""
        self._look.cancel()
        super().connection_lost(exc)


class BoundedWebSocketProtocol(WebSocketsSansIOProtocol):
    """A WebSocket that is not read while its client does not read: answers to its pings take no memory."""

    since_s = 0.0

    @property
    def is_idle(self) -> bool:
        """Whether it is being closed."""
        return self.close_sent

    def connection_lost(self, exc: Exception | None) -> None:
        """Take leave of a closed connection."""
        self.connections.add(self)  # the base class removes it again, also after it made room
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Stop reading while output waits."""
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Read again."""
        super().resume_writing()
        if not (self.read_paused or self.transport.is_closing()):
            self.transport.resume_reading()


Bounded = BoundedHttpProtocol | BoundedWebSocketProtocol


def _abort_longest_idle(others: Sequence[Bounded]) -> None:
    """Close the longest idle connection of the address with the most; never a WebSocket in use."""
    count = Counter(each.client and each.client[0] for each in others)
    may_go = [each for each in others if each.is_idle or isinstance(each, BoundedHttpProtocol)]
    order = sorted(may_go, key=lambda each: (-count[each.client and each.client[0]], not each.is_idle, each.since_s))
    for ended in order[:1]:
        ended.connections.discard(ended)
        ended.transport.abort()
