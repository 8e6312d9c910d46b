"""After its run directory was cleaned the guard stays reachable, or ramps to zero."""

from __future__ import annotations

import os
import select
import shutil
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdhil.guard import guard_socket
from fdhil.guard.guard_protocol import SOCKET_NAME
from fdhil.guard.guard_socket import SocketListener
from tests.guard.guard_rig import GuardRig


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "run"
    made.mkdir()
    return made


@pytest.fixture
def guard_rig(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[GuardRig]:
    monkeypatch.setattr(guard_socket, "LOOK_S", 1e9)  # looked at when a test does
    made = GuardRig(folder)
    yield made
    made.close()


@pytest.mark.parametrize("way", ["removed", "cleaned", "moved", "replaced"])
def test_removed_socket_file_is_created_again(folder: Path, guard_rig: GuardRig, way: str) -> None:
    before = guard_rig.connect()
    guard_rig.serve()
    path = folder / SOCKET_NAME
    if way == "removed":
        path.unlink()
    elif way == "replaced":
        path.unlink()
        path.write_text("of somebody else")
    elif way == "cleaned":
        shutil.rmtree(folder)
    else:
        folder.rename(folder.parent / "elsewhere")
    guard_rig.guard.control._listener.restore_socket_file()
    guard_rig.guard.control._listener.restore_socket_file()  # made once
    guard_rig.serve()
    after = guard_rig.connect()
    assert guard_rig.ask(after, {"request": "disarm"})["ok"]
    assert guard_rig.ask(before, {"request": "status"})["ok"]  # who was connected still is
    assert stat.S_IMODE(path.lstat().st_mode) == 0o600
    guard_rig.guard.control._listener.restore_socket_file()
    assert guard_rig.guard.control.lost == ""


def test_correction_ramps_to_zero_when_no_client_can_connect(folder: Path, guard_rig: GuardRig) -> None:
    guard_rig.into_the_cut()
    folder.rename(folder.parent / "elsewhere")
    folder.write_text("no folder")
    guard_rig.guard.control._listener.restore_socket_file()
    guard_rig.run(400)
    assert (guard_rig.state, guard_rig.offsets()[-1]) == ("OFF", 0)
    recent = list(guard_rig.guard._journal.recent)
    assert [event["event"] for event in recent].count("unreachable") == 1
    assert [event["code"] for event in recent if event.get("state") == "OFF"] == ["Disarmed"]
    folder.unlink()
    guard_rig.guard.control._listener.restore_socket_file()
    guard_rig.serve()
    assert guard_rig.guard._lost == ""
    guard_rig.connect()


def test_world_writable_folder_gets_no_socket(folder: Path, guard_rig: GuardRig) -> None:
    shutil.rmtree(folder)
    folder.mkdir()
    folder.chmod(0o777)
    guard_rig.guard.control._listener.restore_socket_file()
    assert guard_rig.guard.control.lost == "its folder is writable for every user"
    assert not [*folder.iterdir()]


def test_socket_file_is_checked_without_requests(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard_socket, "LOOK_S", 0.01)
    shop = GuardRig(folder)
    (folder / SOCKET_NAME).unlink()
    while not (folder / SOCKET_NAME).exists():
        select.select((), (), (), 0.01)
    shop.close()


def test_recreated_folder_is_accessible_to_the_group(folder: Path) -> None:
    made = SocketListener(folder / SOCKET_NAME, shared=True)
    shutil.rmtree(folder)
    made.restore_socket_file()
    made.adopt_new_listener()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o710
    made.socket.close()


def test_recreated_socket_is_accessible_to_the_group(folder: Path) -> None:
    mask = os.umask(0o077)
    try:
        made = SocketListener(folder / SOCKET_NAME, shared=True)
    finally:
        os.umask(mask)
    assert stat.S_IMODE((folder / SOCKET_NAME).lstat().st_mode) == 0o660
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(folder / SOCKET_NAME))
    made.socket.close()
