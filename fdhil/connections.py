"""Keeps the connections from being taken by who only holds them, so that no stranger locks anybody out of disarming.

One that does nothing is ended; and where there are too many, the longest idle of whoever has the most makes room. How
many may be there is the server's ``limit_concurrency``: beyond it, it would refuse whoever comes.
"""

import asyncio
from collections import Counter
from collections.abc import Sequence
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

MOST_CONNECTIONS = 256
QUIET_S = 20.0
"""For so long, at most twice as long, no request need be whole, and nothing of an answer be read."""


class BoundedHttp(H11Protocol):
    """A connection of HTTP."""

    _look: asyncio.TimerHandle
    _seen = (-1, 0)
    _answers = 0
    since_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, and end another one where there are too many."""
        super().connection_made(transport)
        self.since_s = self.loop.time()
        self._look = self.loop.call_later(QUIET_S, self._end_if_quiet)
        if self.limit_concurrency is not None and len(self.connections) >= self.limit_concurrency:
            _make_room([each for each in self.connections if isinstance(each, Bounded) and each is not self])

    @property
    def idle(self) -> bool:
        """Whether no request of it is being answered."""
        return self.cycle is None or self.cycle.response_complete  # type: ignore[redundant-expr]  # none came yet

    def _end_if_quiet(self) -> None:
        unread = self.transport.get_write_buffer_size()
        before, self._seen = self._seen, (self._answers, unread)
        if before == self._seen and (self.idle or unread):
            self.transport.abort()
        else:
            self._look = self.loop.call_later(QUIET_S, self._end_if_quiet)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self._answers += 1
        self.since_s = self.loop.time()
        super().on_response_complete()

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Hand the connection on to the protocol of sockets, which has its own pings."""
        self._look.cancel()
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self._look.cancel()
        super().connection_lost(exc)


class BoundedSocket(WebSocketsSansIOProtocol):
    """A browser's socket that is not listened to while it does not read: what answers its pings takes no memory."""

    since_s = 0.0

    @property
    def idle(self) -> bool:
        """Whether it has been told that it is over."""
        return self.close_sent

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self.connections.add(self)  # where it made room it is out already, which it would stumble over
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """What it is told waits to be read."""
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """It is read on."""
        super().resume_writing()
        if not (self.read_paused or self.transport.is_closing()):
            self.transport.resume_reading()


Bounded = BoundedHttp | BoundedSocket


def _make_room(others: Sequence[Bounded]) -> None:
    """End the connection that is idle for longest, of the address that has the most; none where sockets are told."""
    count = Counter(each.client and each.client[0] for each in others)
    may_go = [each for each in others if each.idle or isinstance(each, BoundedHttp)]
    order = sorted(may_go, key=lambda each: (-count[each.client and each.client[0]], not each.idle, each.since_s))
    for ended in order[:1]:
        ended.connections.discard(ended)
        ended.transport.abort()
