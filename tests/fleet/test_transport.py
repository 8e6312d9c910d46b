"""An unavailable server is reported at once; the caller decides when to retry."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from fdhil.config.uplink_section import NatsServer
from fdhil.fleet import transport
from fdhil.fleet.transport import connected
from tests.ports import free_port


async def test_a_server_that_is_not_there_is_not_tried_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[Any] = []
    connect = asyncio.open_connection

    async def counted(*where: Any, **how: Any) -> Any:
        tried.append(where)
        assert len(tried) < 5
        return await connect(*where, **how)

    monkeypatch.setattr(asyncio, "open_connection", counted)
    with pytest.raises(ConnectionRefusedError) as error:
        async with connected(NatsServer(server=f"nats://127.0.0.1:{free_port()}"), "fdhil-mill-1", "uplink"):
            pass
    assert tried
    assert "check server" in transport.cause_of(error.value)
