"""Connects to a serial server, which passes the bytes of its serial line over TCP unchanged."""

import asyncio
import time
from typing import cast

from fdhil.drivers.serial.byte_stream import ByteStream
from fdhil.errors import ConnectError

CONNECT_S = 2.0  # in addition to the answer's time-out
CHARACTER_S = 11 / 19200  # the settings of its serial line are unknown


class ServerPort(ByteStream, asyncio.Protocol):
    """A TCP connection to a serial server. The times on its serial line are unknown: ``compute_wire_ns`` is 0."""

    character_s = CHARACTER_S

    def __init__(self, host: str, port: int) -> None:
        super().__init__()
        self._host, self._port = host, port
        self.where = f"the connection to the serial server {host}:{port}"
        self._transport: asyncio.WriteTransport | None = None

    @property
    def is_open(self) -> bool:
        return self._transport is not None and not self._gone

    def compute_wire_ns(self, count: int) -> int:
        """Return 0: the time on the wire is part of the answer's delay."""
        return 0

    async def connect(self, name: str, timeout_s: float) -> None:
        self.close()
        try:
            async with asyncio.timeout(timeout_s + CONNECT_S):
                await asyncio.get_running_loop().create_connection(lambda: self, self._host, self._port)
        except (OSError, TimeoutError):
            text = f"the serial server {self._host}:{self._port} cannot be reached; check its supply, host and port"
            raise ConnectError(name, text) from None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.WriteTransport", transport)

    def data_received(self, data: bytes) -> None:
        self._store_bytes(data)

    def connection_lost(self, error: Exception | None) -> None:
        if self._transport is not None:
            self._end_stream(str(error) if error else "the server closed it")

    def send(self, name: str, data: bytes) -> int:
        if self._transport is None or self._gone:
            raise self._make_gone_error(name)
        self._transport.write(data)
        return time.monotonic_ns()

    def close(self) -> None:
        transport, self._transport, self._gone = self._transport, None, ""
        if transport is not None:
            transport.close()
        self.discard_input()
