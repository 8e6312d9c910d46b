"""After its run directory was cleaned the daemon stays reachable, or disarms."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.desk import ArmingDesk
from fdhil.arming.token import TOKEN_NAME, read_token
from fdhil.config import Access
from fdhil.daemon import control
from fdhil.daemon.control import SOCKET_NAME, ControlServer, ask
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.daemon.peers import Peer
from fdhil.daemon.reachability import reach_again
from tests.daemon.machine import config_of


@pytest.fixture(autouse=True)
def _looks_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "LOOK_S", 0.01)


@asynccontextmanager
async def served(path: Path) -> AsyncIterator[asyncio.Queue[str]]:
    lost = asyncio.Queue[str]()

    async def handle(request: Mapping[str, Any], peer: Peer) -> Mapping[str, Any]:
        return {"ok": True}

    path.parent.mkdir(exist_ok=True)
    server = ControlServer(handle, lambda: None, lambda: None, Access(), lost=lost.put)
    async with server.serving(path):
        assert (await asyncio.to_thread(ask, path, {"request": "status"}))["ok"]
        yield lost


@pytest.mark.parametrize("way", ["removed", "cleaned", "moved"])
async def test_socket_whose_name_is_gone_is_made_again(tmp_path: Path, way: str) -> None:
    path = tmp_path / "run" / SOCKET_NAME
    async with served(path) as lost:
        reader, writer = await asyncio.open_unix_connection(str(path))
        for _ in range(2):
            if way == "removed":
                path.unlink()
            elif way == "cleaned":
                shutil.rmtree(path.parent)
            else:
                shutil.move(path.parent, tmp_path / f"elsewhere{_}")
            assert await lost.get() == ""
            assert (await asyncio.to_thread(ask, path, {"request": "status"}))["ok"]
        writer.write(b'{"request": "status"}\n')  # who was connected still is
        assert await reader.readline() == b'{"ok": true}\n'
        writer.close()
    assert not path.exists()


async def test_name_that_cannot_be_had_again_is_told_once_and_tried_on(tmp_path: Path) -> None:
    path = tmp_path / "run" / SOCKET_NAME
    async with served(path) as lost:
        shutil.rmtree(path.parent)
        path.parent.write_text("no folder")
        assert "cannot be created" in await lost.get()
        path.parent.unlink()
        assert await lost.get() == ""
        assert (await asyncio.to_thread(ask, path, {"request": "status"}))["ok"]


async def test_the_token_that_the_guard_knows_is_written_again(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    run = config.run_directory
    run.mkdir(parents=True)
    desk = ArmingDesk(config, OutcomeStore(config), run)
    desk.begin({}, [])
    before = read_token(run)
    (run / TOKEN_NAME).unlink()
    notice = await reach_again(desk, "")
    assert (notice.code, notice.severity, read_token(run)) == ("SocketLost", "minor", before)


async def test_daemon_disarms_where_its_socket_cannot_be_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of(tmp_path)
    desk = ArmingDesk(config, OutcomeStore(config), config.run_directory)
    disarmed = []

    async def disarm() -> Mapping[str, Any]:
        disarmed.append(True)
        return {"ok": True}

    monkeypatch.setattr(desk, "disarm", disarm)
    for trouble in ("the disk is read-only", ""):  # the second time the token's folder is not there
        notice = await reach_again(desk, trouble)
        assert (notice.code, notice.severity) == ("SocketLost", "MAJOR")
    assert disarmed == [True, True]
