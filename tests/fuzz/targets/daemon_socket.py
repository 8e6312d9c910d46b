"""Lines on the daemon's socket from any user: each has one JSON answer, and arms nothing without the token."""

from __future__ import annotations

import asyncio
import json
import socket
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

from fdhil.arming.refusals import Answer
from fdhil.config import Access
from fdhil.daemon import service_log
from fdhil.daemon.daemon_access import ClientProcess
from fdhil.daemon.daemon_service import DaemonService
from fdhil.daemon.daemon_socket import ControlServer
from fdhil.guard.guard_access import Role
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.fuzz.input_assessment import Target

_FOLDER = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
_LOOP = asyncio.new_event_loop()
PEERS = (
    ClientProcess("o", 0, 1, Role.COMMISSION),
    ClientProcess("w", 1, 2, Role.WATCH),
    ClientProcess("n", 2, 3, Role.NOBODY),
)
SAID: list[dict[str, Any]] = [
    {"request": "status"},
    {"request": "live"},
    {"request": "arm", "program": "/nowhere/part.ngc", "method": "inverse", "token": "t", "whole": True},
    {"request": "disarm"},
    {"request": "acknowledge", "notices": [1], "up_to": 3, "note": "seen", "by": "me"},
    {"request": "stop", "progress": True},
]


async def _build_server() -> ControlServer:
    config = config_of(Path(_FOLDER.name))
    config.store.directory.mkdir(parents=True)
    service = DaemonService(config, SimulatedMachine().open)

    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Answer:
        answer = await service._audit.answer_request(request, peer)
        await service._audit.wait_until_written()
        return answer

    return ControlServer(handle, lambda: None, lambda: None, Access())


_SERVER = _LOOP.run_until_complete(_build_server())


class _Client:
    """Stands in for the writer of an open connection."""

    HERE, THERE = socket.socketpair()

    def get_extra_info(self, name: str) -> socket.socket:
        assert name == "socket"
        return self.HERE

    def write(self, data: bytes) -> None:
        json.loads(data)

    def is_closing(self) -> bool:
        return False


async def _answer_line(data: bytes) -> None:
    peer, client = PEERS[data[0] % len(PEERS)], _Client()
    answer = await _SERVER._answer_line(data[1:], peer, client)  # type: ignore[arg-type] # stands for it
    line = json.dumps(answer)
    assert type(answer["ok"]) is bool
    assert answer.get("armed") is None
    assert len(line) < 1 << 16


def taste(data: bytes) -> None:
    """Send the bytes as a line, from the user selected by the first byte."""
    if data:
        with patch.object(service_log, "write_line"):
            _LOOP.run_until_complete(_answer_line(data))


def target() -> Target:
    seeds = [bytes([k % 3]) + json.dumps(said).encode() for k, said in enumerate(SAID)]
    seeds += [b"\0" + json.dumps(said).encode() for said in SAID]
    words = [
        b'"request"',
        b'"arm"',
        b'"acknowledge"',
        b'"disarm"',
        b"NaN",
        b"1e999",
        b"null",
        b"\\ud800",
        b"[[[[",
        b"9" * 30,
    ]
    return Target("daemon_socket", seeds, taste, words, 600)
