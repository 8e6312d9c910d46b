"""Real peers of the NC sources: each answers on a socket of this computer, as the NC's own interface does."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol, Self

from fdhil.records import MoveKind
from tests.drivers.nc.modbus_peer import ModbusPeer
from tests.drivers.nc.mtconnect_peer import MtConnectPeer
from tests.drivers.nc.opcua_peer import OpcUaPeer


class Peer(Protocol):
    """An NC's interface: entered it answers on a port of its own, left it is gone.

    ``settings`` are the keys of its section of [nc_source], known once it was entered. ``tells`` are the fields of
    NcState that it can tell besides the motion; ``knows`` the kinds of motion that it can tell apart.
    """

    tells: frozenset[str]
    knows: frozenset[MoveKind]

    @property
    def settings(self) -> Mapping[str, Any]: ...
    async def __aenter__(self) -> Self: ...
    async def __aexit__(self, *exception: object) -> None: ...
    async def set_state(self, motion: MoveKind, **fields: Any) -> None:
        """Set the NC's state; ``fields`` are those of NcState."""

    async def send_invalid_data(self) -> None:
        """Answer with invalid content from now on."""


class BridgePeer:
    """Sends the bridge's lines, as fdhil/bridges/linuxcnc.py does."""

    tells = frozenset({"line", "feed_override", "rapid_override", "feed_hold", "tool", "program"})
    knows = frozenset(MoveKind) - {MoveKind.UNKNOWN}
    period_s = 0.02

    def __init__(self) -> None:
        self._now: dict[str, Any] = {"motion": "rest"}
        self._nonsense = False
        self._writers: list[asyncio.StreamWriter] = []

    @property
    def settings(self) -> Mapping[str, Any]:
        return {"port": self._port}

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve_client, "127.0.0.1", 0)
        self._port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exception: object) -> None:
        self._server.close()
        for writer in self._writers:
            writer.close()
        await self._server.wait_closed()

    async def _serve_client(self, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.append(writer)
        try:
            writer.write(json.dumps({"schema": "fdhil-linuxcnc-1", "servo_period_s": 0.001}).encode() + b"\n")
            while not writer.is_closing():
                now_ns = time.monotonic_ns()
                reported = {"stamp_ns": now_ns, "error_ns": 2_000_000, "cycle": now_ns // 1_000_000, "mm": {"X": 0.0}}
                line = b"GET / HTTP/1.1" if self._nonsense else json.dumps({**reported, **self._now}).encode()
                writer.write(line + b"\n")
                await writer.drain()
                await asyncio.sleep(self.period_s)
        except OSError:
            pass
        finally:
            writer.close()

    async def set_state(self, motion: MoveKind, **fields: Any) -> None:
        self._now = {"motion": motion.value, **fields}

    async def send_invalid_data(self) -> None:
        self._nonsense = True


PEERS: Mapping[str, Callable[[], AbstractAsyncContextManager[Peer] | Any]] = {
    "linuxcnc": BridgePeer,
    "modbus_coil": ModbusPeer,
    "mtconnect": MtConnectPeer,
    "opcua": OpcUaPeer,
}
"""The peer of each entry of ``tables.NC_SOURCES``."""
