"""Rights of the daemon's clients, as identified by the kernel, and the audit of their requests."""

from __future__ import annotations

import asyncio
import json
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fdhil import config as machine_config
from fdhil.cli.main import cli
from fdhil.config import Access
from fdhil.daemon.audit_middleware import TOLD, AuditMiddleware
from fdhil.daemon.daemon_access import NEEDS, ClientProcess, get_role
from fdhil.daemon.daemon_socket import ControlServer
from fdhil.guard.guard_access import Role
from fdhil.store import audit_file
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.daemon.test_daemon_service import serving
from tests.listening_ports import list_tcp_ports
from tests.machine.virtual_time import VirtualClock

CONFIGS = Path(__file__).parents[2] / "configs"
ACCESS = Access(watch=("looker",), operate=("operator",))
STRANGER = 65534


@pytest.mark.parametrize(
    ("user", "uid", "role"),
    [
        ("root", 0, Role.COMMISSION),
        ("me", os.getuid(), Role.COMMISSION),
        ("operator", 4711, Role.OPERATE),
        ("looker", 4712, Role.WATCH),
        ("stranger", 4713, Role.NOBODY),
    ],
)
def test_user_gets_its_role(user: str, uid: int, role: Role) -> None:
    assert get_role(user, uid, ACCESS) is role


def test_unlisted_request_needs_the_highest_role_and_watching_users_may_disarm() -> None:
    watcher = ClientProcess("looker", 4712, 1, Role.WATCH)
    assert [what for what in (*NEEDS, "stop", "anything") if watcher.may_request(what)] == ["status", "live", "disarm"]
    operator = ClientProcess("operator", 4711, 1, Role.OPERATE)
    assert not operator.may_request("stop")
    assert not operator.may_request("anything")


class ArmingServiceStub:
    def __init__(self) -> None:
        self.done: list[str] = []

    async def handle(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self.done.append(str(request["request"]))
        return {"ok": True, "text": "armed part.ngc"}


@pytest.mark.fault("G1")
@pytest.mark.parametrize("role", list(Role))
async def test_request_without_the_role_is_refused_and_audited(role: Role, tmp_path: Path) -> None:
    desk = ArmingServiceStub()
    audited = AuditMiddleware(desk.handle, tmp_path)
    peer = ClientProcess("somebody", 4711, 99, role)
    for what in (*NEEDS, "stop"):
        answer = await audited.answer_request({"request": what, "token": "SECRET"}, peer)
        assert answer["ok"] == peer.may_request(what) == (what in desk.done)
        assert answer["ok"] or answer["code"] == "AuthRequired"
        await audited.wait_until_written()
    reported = [
        (entry.get("asked") or entry["answered"], entry.get("result")) for entry, _ in audit_file.read_entries(tmp_path)
    ]
    refused = [what for what, result in reported if result == "AuthRequired"]
    assert refused == [what for what in (*NEEDS, "stop") if not peer.may_request(what)]
    assert {what for what, result in reported if result == "done"} == set(desk.done) - {"status", "live"}
    assert b"SECRET" not in b"".join(path.read_bytes() for path in tmp_path.iterdir())


async def test_request_is_audited_before_execution_and_its_answer_logged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    at_that_time: list[dict[str, Any]] = []

    async def handle(request: Mapping[str, Any]) -> dict[str, Any]:
        at_that_time.extend(entry for entry, _ in audit_file.read_entries(tmp_path))
        return {"ok": False, "code": "ModelStale", "text": "too old"}

    peer = ClientProcess("fdhil-web", 990, 99, Role.OPERATE)
    await AuditMiddleware(handle, tmp_path).answer_request(
        {"request": "arm", "program": "/p/part.ngc", "by": "anna"}, peer
    )
    assert [(entry["asked"], entry["by"], entry["who"]["user"]) for entry in at_that_time] == [
        ("arm", "anna", "fdhil-web")
    ]
    last = list(audit_file.read_entries(tmp_path))[-1][0]
    assert (last["answered"], last["result"], last["program"]) == ("arm", "ModelStale", "/p/part.ngc")
    assert "fdhil-web (process 99) for anna requested arm: ModelStale" in capsys.readouterr().err


@pytest.mark.fault("F5")
async def test_unauditable_request_is_refused_except_disarm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    desk, peer = ArmingServiceStub(), ClientProcess("me", os.getuid(), 99, Role.COMMISSION)
    audited = AuditMiddleware(desk.handle, tmp_path / "not there")
    for what in ("arm", "acknowledge", "disarm", "stop"):
        answer = await audited.answer_request({"request": what}, peer)
        assert answer["ok"] == (what in ("disarm", "stop"))
    await audited.wait_until_written()
    assert desk.done == ["disarm", "stop"]
    assert capsys.readouterr().err.count("could not be recorded in the audit log") == 4


@pytest.mark.fault("F12")
async def test_flood_of_requests_does_not_fill_the_disk(tmp_path: Path) -> None:
    desk = ArmingServiceStub()
    audited = AuditMiddleware(desk.handle, tmp_path)
    stranger, owner = (
        ClientProcess("stranger", 4713, 1, Role.NOBODY),
        ClientProcess("me", os.getuid(), 1, Role.COMMISSION),
    )
    for _ in range(300):
        assert (await audited.answer_request({"request": "arm"}, stranger))["code"] == "AuthRequired"
        assert (await audited.answer_request({"request": "disarm"}, owner))["ok"]
    await audited.wait_until_written()
    assert desk.done == ["disarm"] * 300
    assert len(list(audit_file.read_entries(tmp_path))) < 100


async def test_suppressed_disarm_is_audited_a_moment_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fdhil.daemon.audit_middleware.HELD_S", 0.05)
    desk, watcher = ArmingServiceStub(), ClientProcess("looker", 4712, 1, Role.WATCH)
    audited = AuditMiddleware(desk.handle, tmp_path)

    def told() -> int:
        return sum(1 + entry.get("not_written", 0) for entry, _ in audit_file.read_entries(tmp_path))

    for _ in range(60):
        await audited.answer_request({"request": "disarm"}, watcher)
    async with asyncio.timeout(60.0):
        while told() < 60:  # noqa: ASYNC110 - it is a file
            await asyncio.sleep(0.01)
    for _ in range(5):
        await audited.answer_request({"request": "disarm"}, watcher)
    await audited.wait_until_written()
    assert (told(), len(desk.done)) == (65, 65)
    assert len(list(audit_file.read_entries(tmp_path))) < 30


@pytest.mark.fault("F12", "G1")
async def test_refused_user_gets_one_short_audit_line_a_minute(tmp_path: Path) -> None:
    clock = VirtualClock()
    audited, stranger = (
        AuditMiddleware(ArmingServiceStub().handle, tmp_path, clock),
        ClientProcess("stranger", 4713, 1, Role.NOBODY),
    )
    long = dict.fromkeys(TOLD, "\U0001f600" * 500)
    for minute in range(3):
        clock.advance(1000.0 + 61.0 * minute)
        for what in (*NEEDS, "stop", "anything"):
            for _ in range(10):
                assert (await audited.answer_request({**long, "request": what}, stranger))["code"] == "AuthRequired"
    result = [entry.get("not_written", 0) for entry, _ in audit_file.read_entries(tmp_path)]
    assert result == [0, 69, 69]
    await audited.wait_until_written()
    assert sum(1 + entry.get("not_written", 0) for entry, _ in audit_file.read_entries(tmp_path)) == 210
    assert (tmp_path / audit_file.AUDIT_FILE_NAME).stat().st_size < 4000


async def test_failed_request_is_audited(tmp_path: Path) -> None:
    async def handle(request: Mapping[str, Any]) -> dict[str, Any]:
        raise ZeroDivisionError("made up")

    audited, owner = AuditMiddleware(handle, tmp_path), ClientProcess("me", os.getuid(), 1, Role.COMMISSION)
    for what in ("arm", "disarm"):
        with pytest.raises(ZeroDivisionError):
            await audited.answer_request({"request": what}, owner)
    await audited.wait_until_written()
    result = [
        (entry["answered"], entry["result"]) for entry, _ in audit_file.read_entries(tmp_path) if "answered" in entry
    ]
    assert result == [("arm", "ZeroDivisionError"), ("disarm", "ZeroDivisionError")]


@pytest.mark.fault("F12")
async def test_long_unknown_request_names_fill_neither_disk_nor_memory(tmp_path: Path) -> None:
    audited, watcher = (
        AuditMiddleware(ArmingServiceStub().handle, tmp_path),
        ClientProcess("looker", 4712, 1, Role.WATCH),
    )
    for k in range(100):
        assert (await audited.answer_request({"request": f"{k}" + "x" * 60_000}, watcher))["code"] == "AuthRequired"
    kept = list(audit_file.read_entries(tmp_path))
    assert 1 <= len(kept) < 50
    assert [fault for _, fault in kept if fault] == []
    assert max(len(entry["answered"]) for entry, _ in kept) <= 500


@pytest.fixture
def open_folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o755)
        yield folder


def test_only_the_owner_may_open_the_socket_unless_users_are_named(open_folder: Path) -> None:
    async def mode(access: Access) -> int:
        async with ControlServer(
            AuditMiddleware(ArmingServiceStub().handle, open_folder).answer_request, lambda: None, print, access
        ).serve_socket(open_folder / "s"):
            return stat.S_IMODE((open_folder / "s").stat().st_mode)

    open_folder.chmod(0o700)
    assert asyncio.run(mode(Access())) == 0o600
    assert stat.S_IMODE(open_folder.stat().st_mode) == 0o700
    assert asyncio.run(mode(ACCESS)) == 0o660
    assert stat.S_IMODE(open_folder.stat().st_mode) == 0o710  # they come as far as the socket


ASK = """
import json, os, sys
from pathlib import Path
from fdhil.daemon.daemon_socket import ask_daemon
os.setgroups([])
os.setuid(int(sys.argv[2]))
print(json.dumps([ask_daemon(Path(sys.argv[1]), {"request": what}) for what in ("status", "disarm", "arm", "stop")]))
"""


@pytest.mark.usefixtures("processes")
@pytest.mark.skipif(os.getuid() != 0, reason="only root may become another user")
@pytest.mark.parametrize("role", [Role.WATCH, Role.OPERATE])
async def test_other_user_is_identified_by_the_kernel(role: Role, open_folder: Path) -> None:
    desk = ArmingServiceStub()
    access = Access(**{role.name.lower(): ("nobody",)})
    control = ControlServer(AuditMiddleware(desk.handle, open_folder).answer_request, lambda: None, print, access)
    async with control.serve_socket(open_folder / "s"):
        command = [sys.executable, "-c", ASK, str(open_folder / "s"), str(STRANGER)]
        asked = await asyncio.to_thread(subprocess.run, command, capture_output=True, timeout=60, check=True)
    assert [answer["ok"] for answer in json.loads(asked.stdout)] == [True, True, role is Role.OPERATE, False]
    who = {entry["who"]["user"] for entry, _ in audit_file.read_entries(open_folder)}
    assert who == {"nobody"}


def test_audit_command_shows_entries_and_tampering(tmp_path: Path) -> None:
    config = tmp_path / "machine.toml"
    config.write_text((CONFIGS / "sim.toml").read_text())
    folder = machine_config.load_config(config).store.directory
    folder.mkdir()
    for program in ("a.ngc", "b.ngc"):
        audit_file.append_entry(
            folder, {"who": {"user": "fdhil-web", "uid": 1, "pid": 2}, "asked": "arm", "by": "anna", "program": program}
        )
    shown = CliRunner().invoke(cli, ["audit", str(config)], standalone_mode=False)
    assert shown.return_value == 0
    assert "fdhil-web for anna  arm a.ngc (requested)" in shown.output
    assert "2 entries, all intact" in shown.output
    path = folder / audit_file.AUDIT_FILE_NAME
    path.write_text(path.read_text().replace("a.ngc", "c.ngc"))
    shown = CliRunner().invoke(cli, ["audit", str(config), "--json"], standalone_mode=False)
    assert shown.return_value == 1
    assert json.loads(shown.output)["broken"] == [1]
    for nonsense in ({}, {"who": "root"}, {"who": {}, "result": 5}):  # sealed, but by no command of fdhil
        audit_file.append_entry(folder, nonsense)
    assert CliRunner().invoke(cli, ["audit", str(config)], standalone_mode=False).output.count("NOT INTACT") == 3


def test_rights_of_users_do_not_change_the_config_digest(tmp_path: Path) -> None:
    assert config_of(tmp_path).digest == config_of(tmp_path, access={"watch": ["looker"]}).digest
    assert config_of(tmp_path).digest != config_of(tmp_path, guard={"node_id": 99}).digest


@pytest.mark.fault("G3")
async def test_daemon_listens_at_no_tcp_port(tmp_path: Path) -> None:
    before = list_tcp_ports(os.getpid())
    async with serving(config_of(tmp_path), SimulatedMachine()):
        assert list_tcp_ports(os.getpid()) == before
        server = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
        assert len(list_tcp_ports(os.getpid()) - before) == 1  # one that did would be seen
        server.close()
