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

from fdhil.guard import control
from fdhil.guard.control import Listener
from fdhil.guard.protocol import SOCKET_NAME
from tests.guard.shop import Shop


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "run"
    made.mkdir()
    return made


@pytest.fixture
def shop(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shop]:
    monkeypatch.setattr(control, "LOOK_S", 1e9)  # looked at when a test does
    made = Shop(folder)
    yield made
    made.close()


@pytest.mark.parametrize("way", ["removed", "cleaned", "moved", "replaced"])
def test_socket_whose_name_is_gone_is_made_again(folder: Path, shop: Shop, way: str) -> None:
    before = shop.connect()
    shop.serve()
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
    shop.guard.control._listener.look()
    shop.guard.control._listener.look()  # made once
    shop.serve()
    after = shop.connect()
    assert shop.ask(after, {"request": "disarm"})["ok"]
    assert shop.ask(before, {"request": "status"})["ok"]  # who was connected still is
    assert stat.S_IMODE(path.lstat().st_mode) == 0o600
    shop.guard.control._listener.look()
    assert shop.guard.control.lost == ""


def test_correction_is_ramped_to_zero_where_nobody_could_ask_for_it_any_more(folder: Path, shop: Shop) -> None:
    shop.into_the_cut()
    folder.rename(folder.parent / "elsewhere")
    folder.write_text("no folder")
    shop.guard.control._listener.look()
    shop.run(400)
    assert (shop.state, shop.offsets()[-1]) == ("OFF", 0)
    recent = list(shop.guard._journal.recent)
    assert [event["event"] for event in recent].count("unreachable") == 1
    assert [event["code"] for event in recent if event.get("state") == "OFF"] == ["Disarmed"]
    folder.unlink()
    shop.guard.control._listener.look()
    shop.serve()
    assert shop.guard._lost == ""
    shop.connect()


def test_folder_that_anybody_may_write_to_gets_no_socket(folder: Path, shop: Shop) -> None:
    shutil.rmtree(folder)
    folder.mkdir()
    folder.chmod(0o777)
    shop.guard.control._listener.look()
    assert shop.guard.control.lost == "its folder is writable for every user"
    assert not [*folder.iterdir()]


def test_the_name_is_looked_at_without_being_asked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "LOOK_S", 0.01)
    shop = Shop(folder)
    (folder / SOCKET_NAME).unlink()
    while not (folder / SOCKET_NAME).exists():
        select.select((), (), (), 0.01)
    shop.close()


def test_folder_that_is_made_again_is_open_to_a_group_that_may_ask(folder: Path) -> None:
    made = Listener(folder / SOCKET_NAME, shared=True)
    shutil.rmtree(folder)
    made.look()
    made.renew()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o710
    made.socket.close()


def test_socket_of_a_group_is_open_to_it(folder: Path) -> None:
    mask = os.umask(0o077)
    try:
        made = Listener(folder / SOCKET_NAME, shared=True)
    finally:
        os.umask(mask)
    assert stat.S_IMODE((folder / SOCKET_NAME).lstat().st_mode) == 0o660
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(folder / SOCKET_NAME))
    made.socket.close()
