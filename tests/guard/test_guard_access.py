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

from fdhil.guard import guard_process
from fdhil.guard.guard_access import NEEDS, ClientProcess, GuardAccess, Role
from fdhil.guard.guard_process import DECIDED
from fdhil.guard.guard_socket import GuardSocketServer
from tests.guard.guard_rig import TOKEN, GuardRig
from tests.guard.simulated_bus import FACTS_GIVEN, commissioned, settings

DAEMON, WATCHER, STRANGER = 4711, 4712, 4713
ACCESS = GuardAccess(DAEMON, (WATCHER,))
ASKED = ("status", "alive", "table", *DECIDED, "anything", 7, None, ["arm"])
REQUESTS: dict[str, dict[str, Any]] = {
    "arm": {"request": "arm", "token": TOKEN, "program_digest": "program-1", "facts": dict(FACTS_GIVEN)},
    "adopt": {"request": "adopt", "token": TOKEN},
    "compared": {"request": "compared", "token": TOKEN, "axes": {"X": "another drive"}},
}


@pytest.fixture
def guard_rig(tmp_path: Path) -> Iterator[GuardRig]:
    made = GuardRig(tmp_path, replace(commissioned(settings()), daemon_uid=DAEMON, watching=(WATCHER,)))
    yield made
    made.close()


def become(monkeypatch: pytest.MonkeyPatch, uid: int) -> None:
    monkeypatch.setattr("fdhil.guard.guard_socket.read_peer_credentials", lambda _: (99, uid))


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
def test_user_gets_its_role(uid: int, role: Role) -> None:
    assert ACCESS.get_role(uid) is role


def test_each_role_may_make_its_requests() -> None:
    may = {role: [what for what in ASKED if ClientProcess(1, 1, role).may_request(what)] for role in Role}
    assert may[Role.NOBODY] == []
    assert may[Role.WATCH] == ["status", "disarm"]
    assert may[Role.OPERATE] == ["status", "alive", "table", "arm", "feedforward", "disarm", "adopt"]
    assert may[Role.COMMISSION] == list(ASKED)  # also what there is not: it is told so
    assert all(what in ASKED for what in NEEDS)


@pytest.mark.parametrize(("daemon", "watching", "mode"), [(None, (), 0o600), (7, (), 0o660), (None, (8,), 0o660)])
def test_socket_is_private_unless_users_are_named(
    daemon: int | None, watching: tuple[int, ...], mode: int, tmp_path: Path
) -> None:
    service = GuardSocketServer(tmp_path, GuardAccess(daemon, watching), lambda *_: None)
    assert service.path.stat().st_mode & 0o777 == mode
    service.close()


@pytest.mark.fault("G1")
def test_watching_user_may_disarm_but_not_arm(guard_rig: GuardRig, monkeypatch: pytest.MonkeyPatch) -> None:
    armed = guard_rig.into_the_cut()
    become(monkeypatch, WATCHER)
    client = guard_rig.connect()
    for what, request in REQUESTS.items():
        answer = guard_rig.ask(client, request)
        assert (answer["ok"], answer["code"]) == (False, "AuthRequired")
        assert what in answer["text"]
        assert guard_rig.state == "ACTIVE"
        armed.send(b'{"request": "alive"}\n')
    assert guard_rig.guard.state.axes[0].record_void is False
    assert guard_rig.ask(client, {"request": "status"})["state"] == "ACTIVE"
    assert guard_rig.ask(client, {"request": "disarm"})["ok"]
    assert guard_rig.state == "RAMP_DOWN"


@pytest.mark.fault("G1")
def test_daemon_may_arm_but_not_confirm_a_comparison(guard_rig: GuardRig, monkeypatch: pytest.MonkeyPatch) -> None:
    become(monkeypatch, DAEMON)
    client = guard_rig.arm()
    assert guard_rig.state == "ARMED"
    answer = guard_rig.ask(client, REQUESTS["compared"])
    assert (answer["code"], guard_rig.guard.state.axes[0].record_void) == ("AuthRequired", False)
    granted = [event for event in guard_rig.events() if event["event"] == "granted"]
    assert [(event["request"], event["uid"], event["pid"]) for event in granted] == [("arm", DAEMON, 99)]


@pytest.mark.fault("G1")
def test_unknown_user_is_refused_and_disconnected(guard_rig: GuardRig, monkeypatch: pytest.MonkeyPatch) -> None:
    become(monkeypatch, STRANGER)
    client = guard_rig.connect()
    answer = guard_rig.answer(client)
    assert (answer["code"], "has no access to the guard" in answer["text"]) == ("AuthRequired", True)
    assert guard_rig.guard.control.clients == []
    assert [(e["request"], e["uid"]) for e in guard_rig.events() if e["event"] == "refused"] == [("to talk", STRANGER)]


@pytest.mark.fault("F12", "G1")
def test_frequent_refusals_are_counted_without_filling_the_journal(
    guard_rig: GuardRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard_process, "REFUSED_S", 1e9)
    guard_rig.guard._refused_s = -1e9  # nobody was refused for long
    become(monkeypatch, WATCHER)
    client = guard_rig.connect()
    for _ in range(50):
        assert guard_rig.ask(client, REQUESTS["arm"])["code"] == "AuthRequired"
    guard_rig.guard._refused_s = -1e9
    guard_rig.ask(client, {"request": ["no", "text"]})
    refused = [(event["request"], event["times"]) for event in guard_rig.events() if event["event"] == "refused"]
    assert refused == [("arm", 1), ("['no', 'text']", 50)]


@pytest.mark.fault("G1")
def test_wrong_token_is_journaled(guard_rig: GuardRig) -> None:
    client = guard_rig.connect()
    assert "AuthRequired" in str(guard_rig.ask(client, {"request": "adopt", "token": "guessed"}))
    events = [event for event in guard_rig.events() if event["event"] == "refused"]
    assert [(event["request"], event["uid"]) for event in events] == [("adopt", os.getuid())]
    assert "guessed" not in json.dumps(events)


ASK = """
import json, os, sys
from pathlib import Path
from fdhil.arming.guard_client import GuardClient
os.setgroups([])
os.setuid(int(sys.argv[2]))
with GuardClient(Path(sys.argv[1]), 60.0) as guard:
    print(json.dumps([guard.send_request({"request": what}) for what in ("status", "disarm", "adopt")]))
"""


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(os.getuid() != 0, reason="only root may become another user")
@pytest.mark.fault("G1")
def test_other_user_is_identified_by_the_kernel() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        shop = GuardRig(folder, replace(commissioned(settings()), watching=(65534,)))
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
