"""An unavailable server is reported at once; the caller decides when to retry."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from fdhil.config.uplink_section import NatsServer
from fdhil.fleet import nats_transport
from fdhil.fleet.nats_transport import connect_to_server
from tests.free_ports import find_free_port


async def test_unavailable_server_is_reported_quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[Any] = []
    connect = asyncio.open_connection

    async def counted(*where: Any, **how: Any) -> Any:
        tried.append(where)
        assert len(tried) < 5
        return await connect(*where, **how)

    monkeypatch.setattr(asyncio, "open_connection", counted)
    with pytest.raises(ConnectionRefusedError) as error:
        async with connect_to_server(
            NatsServer(server=f"nats://127.0.0.1:{find_free_port()}"), "fdhil-mill-1", "uplink"
        ):
            pass
    assert tried
    assert "check server" in nats_transport.describe_cause(error.value)
