"""Rights of the guard's clients, as identified by the kernel: watchers may disarm, only the daemon may arm."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fdhil.guard import process
from fdhil.guard.control import Control
from fdhil.guard.peers import NEEDS, Access, Peer, Role
from fdhil.guard.process import DECIDED
from tests.guard.machine import FACTS_GIVEN, commissioned, settings
from tests.guard.shop import TOKEN, Shop

DAEMON, WATCHER, STRANGER = 4711, 4712, 4713
ACCESS = Access(DAEMON, (WATCHER,))
ASKED = ("status", "alive", "table", *DECIDED, "anything", 7, None, ["arm"])
REQUESTS: dict[str, dict[str, Any]] = {
    "arm": {"request": "arm", "token": TOKEN, "program_digest": "program-1", "facts": dict(FACTS_GIVEN)},
    "adopt": {"request": "adopt", "token": TOKEN},
    "compared": {"request": "compared", "token": TOKEN, "axes": {"X": "another drive"}},
}


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    made = Shop(tmp_path, replace(commissioned(settings()), daemon_uid=DAEMON, watching=(WATCHER,)))
    yield made
    made.close()


def become(monkeypatch: pytest.MonkeyPatch, uid: int) -> None:
    monkeypatch.setattr("fdhil.guard.control.credentials", lambda _: (99, uid))


@pytest.mark.parametrize(
    ("uid", "role"),
    [
        (0, Role.COMMISSION),
        (os.getuid(), Role.COMMISSION),
        (DAEMON, Role.OPERATE),
        (WATCHER, Role.WATCH),
        (STRANGER, Role.NOBODY),
    ],
)
def test_the_role_of_a_user(uid: int, role: Role) -> None:
    assert ACCESS.role_of(uid) is role


def test_what_each_role_may_ask_for() -> None:
    may = {role: [what for what in ASKED if Peer(1, 1, role).may(what)] for role in Role}
    assert may[Role.NOBODY] == []
    assert may[Role.WATCH] == ["status", "disarm"]
    assert may[Role.OPERATE] == ["status", "alive", "table", "arm", "feedforward", "disarm", "adopt"]
    assert may[Role.COMMISSION] == list(ASKED)  # also what there is not: it is told so
    assert all(what in ASKED for what in NEEDS)


@pytest.mark.parametrize(("daemon", "watching", "mode"), [(None, (), 0o600), (7, (), 0o660), (None, (8,), 0o660)])
def test_the_socket_is_the_guards_alone_unless_others_are_named(
    daemon: int | None, watching: tuple[int, ...], mode: int, tmp_path: Path
) -> None:
    desk = Control(tmp_path, Access(daemon, watching), lambda *_: None)
    assert desk.path.stat().st_mode & 0o777 == mode
    desk.close()


@pytest.mark.fault("G1")
def test_a_watcher_may_disarm_what_he_may_not_arm(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    armed = shop.into_the_cut()
    become(monkeypatch, WATCHER)
    client = shop.connect()
    for what, request in REQUESTS.items():
        answer = shop.ask(client, request)
        assert (answer["ok"], answer["code"]) == (False, "AuthRequired")
        assert what in answer["text"]
        assert shop.state == "ACTIVE"
        armed.send(b'{"request": "alive"}\n')
    assert shop.guard.state.axes[0].record_void is False
    assert shop.ask(client, {"request": "status"})["state"] == "ACTIVE"
    assert shop.ask(client, {"request": "disarm"})["ok"]
    assert shop.state == "RAMP_DOWN"


@pytest.mark.fault("G1")
def test_the_daemon_arms_but_vouches_for_no_drive(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    become(monkeypatch, DAEMON)
    client = shop.arm()
    assert shop.state == "ARMED"
    answer = shop.ask(client, REQUESTS["compared"])
    assert (answer["code"], shop.guard.state.axes[0].record_void) == ("AuthRequired", False)
    granted = [event for event in shop.events() if event["event"] == "granted"]
    assert [(event["request"], event["uid"], event["pid"]) for event in granted] == [("arm", DAEMON, 99)]


@pytest.mark.fault("G1")
def test_a_stranger_is_told_and_let_go_and_takes_nobodys_place(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    become(monkeypatch, STRANGER)
    client = shop.connect()
    answer = shop.answer(client)
    assert (answer["code"], "has no access to the guard" in answer["text"]) == ("AuthRequired", True)
    assert shop.guard.control.clients == []
    assert [(e["request"], e["uid"]) for e in shop.events() if e["event"] == "refused"] == [("to talk", STRANGER)]


@pytest.mark.fault("F12", "G1")
def test_who_is_refused_often_is_counted_and_fills_no_journal(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "REFUSED_S", 1e9)
    shop.guard._refused_s = -1e9  # nobody was refused for long
    become(monkeypatch, WATCHER)
    client = shop.connect()
    for _ in range(50):
        assert shop.ask(client, REQUESTS["arm"])["code"] == "AuthRequired"
    shop.guard._refused_s = -1e9
    shop.ask(client, {"request": ["no", "text"]})
    refused = [(event["request"], event["times"]) for event in shop.events() if event["event"] == "refused"]
    assert refused == [("arm", 1), ("['no', 'text']", 50)]


@pytest.mark.fault("G1")
def test_a_wrong_token_is_written_down_too(shop: Shop) -> None:
    client = shop.connect()
    assert "AuthRequired" in str(shop.ask(client, {"request": "adopt", "token": "guessed"}))
    events = [event for event in shop.events() if event["event"] == "refused"]
    assert [(event["request"], event["uid"]) for event in events] == [("adopt", os.getuid())]
    assert "guessed" not in json.dumps(events)


ASK = """
import json, os, sys
from pathlib import Path
from fdhil.arming.guard_client import GuardClient
os.setgroups([])
os.setuid(int(sys.argv[2]))
with GuardClient(Path(sys.argv[1]), 60.0) as guard:
    print(json.dumps([guard.ask({"request": what}) for what in ("status", "disarm", "adopt")]))
"""


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(os.getuid() != 0, reason="only root may become another user")
@pytest.mark.fault("G1")
def test_another_user_of_this_computer_is_known_by_the_kernel() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        shop = Shop(folder, replace(commissioned(settings()), watching=(65534,)))
        (folder / "guard.sock").chmod(0o666)  # the group of the unit is nobody's here
        asked = subprocess.Popen(
            [sys.executable, "-c", ASK, name, "65534"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        ended = threading.Thread(target=asked.wait)
        ended.start()
        while ended.is_alive():
            shop.cycle()
        assert asked.stdout is not None
        answers = json.loads(asked.stdout.read())
        asked.stdout.close()
        shop.close()
    assert [answer["ok"] for answer in answers] == [True, True, False]
    assert answers[2]["text"] == "user 65534 may not request 'adopt' from the guard"
