"""After its run directory was cleaned the daemon stays reachable, or disarms."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.arming_service import ArmingService
from fdhil.arming.operator_token import TOKEN_NAME, read_token
from fdhil.config import Access
from fdhil.daemon import daemon_socket
from fdhil.daemon.daemon_access import ClientProcess
from fdhil.daemon.daemon_socket import SOCKET_NAME, ControlServer, ask_daemon
from fdhil.daemon.outcome_store import OutcomeStore
from fdhil.daemon.socket_recovery import restore_access
from tests.daemon.simulated_machine import config_of


@pytest.fixture(autouse=True)
def _shorten_check_period(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon_socket, "LOOK_S", 0.01)


@asynccontextmanager
async def served(path: Path) -> AsyncIterator[asyncio.Queue[str]]:
    lost = asyncio.Queue[str]()

    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        return {"ok": True}

    path.parent.mkdir(exist_ok=True)
    server = ControlServer(handle, lambda: None, lambda: None, Access(), lost=lost.put)
    async with server.serve_socket(path):
        assert (await asyncio.to_thread(ask_daemon, path, {"request": "status"}))["ok"]
        yield lost


@pytest.mark.parametrize("way", ["removed", "cleaned", "moved"])
async def test_removed_socket_file_is_created_again(tmp_path: Path, way: str) -> None:
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
            assert (await asyncio.to_thread(ask_daemon, path, {"request": "status"}))["ok"]
        writer.write(b'{"request": "status"}\n')  # who was connected still is
        assert await reader.readline() == b'{"ok": true}\n'
        writer.close()
    assert not path.exists()


async def test_failing_socket_recovery_is_reported_once_and_retried(tmp_path: Path) -> None:
    path = tmp_path / "run" / SOCKET_NAME
    async with served(path) as lost:
        shutil.rmtree(path.parent)
        path.parent.write_text("no folder")
        assert "cannot be created" in await lost.get()
        path.parent.unlink()
        assert await lost.get() == ""
        assert (await asyncio.to_thread(ask_daemon, path, {"request": "status"}))["ok"]


async def test_removed_token_is_written_again(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    run = config.run_directory
    run.mkdir(parents=True)
    service = ArmingService(config, OutcomeStore(config), run)
    service.start_from_history({}, [])
    before = read_token(run)
    (run / TOKEN_NAME).unlink()
    notice = await restore_access(service, "")
    assert (notice.code, notice.severity, read_token(run)) == ("SocketLost", "minor", before)


async def test_daemon_disarms_when_its_socket_cannot_be_recovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = config_of(tmp_path)
    service = ArmingService(config, OutcomeStore(config), config.run_directory)
    disarmed = []

    async def disarm() -> Mapping[str, Any]:
        disarmed.append(True)
        return {"ok": True}

    monkeypatch.setattr(service, "disarm", disarm)
    for trouble in ("the disk is read-only", ""):  # the second time the token's folder is not there
        notice = await restore_access(service, trouble)
        assert (notice.code, notice.severity) == ("SocketLost", "MAJOR")
    assert disarmed == [True, True]
