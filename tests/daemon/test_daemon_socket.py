"""Small parts: the socket's client, the notify protocol, log lines, the lock, the token."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import re
import resource
import socket
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from fdhil.arming.operator_token import ensure_token, get_operator_token, make_run_directory, read_token
from fdhil.config import Access
from fdhil.daemon import service_log
from fdhil.daemon.daemon_access import ClientProcess
from fdhil.daemon.daemon_socket import MAX_CLIENTS, ControlServer, ask_daemon
from fdhil.daemon.machine_lock import BusLocked, lock_machine
from fdhil.daemon.service_log import BURST, LogThrottle, escape_unprintable, format_outcome
from fdhil.daemon.systemd_notify import notify_systemd
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProgramError
from fdhil.guard.guard_access import Role
from fdhil.records import Notice, Skill
from tests.store.sample_records import make_outcome, make_published


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(tmp_path / "s"))
        server.listen()
        yield server


def test_absent_daemon_is_reported_with_the_next_action(tmp_path: Path) -> None:
    with pytest.raises(ConnectError, match=r"is not running .*start it with `fdhil run CONFIG`"):
        ask_daemon(tmp_path / "absent", {"request": "status"})


@pytest.mark.parametrize("code", [errno.EACCES, errno.EPERM])
def test_forbidden_socket_is_distinguished_from_an_absent_daemon(code: int) -> None:
    """The advice to start a daemon would start a second one."""
    denied = OSError(code, os.strerror(code))
    result = str(ConnectError.from_socket_error("daemon", denied, "is not running; start it"))
    assert result.startswith(
        f"daemon: does not accept this user ({os.strerror(code)}), so that it is unknown whether it runs"
    )
    assert "start it" not in result


async def test_request_error_is_answered_with_its_exit_code(tmp_path: Path) -> None:
    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        raise ProgramError(3, "G77", "is no G code; correct the program")

    async with ControlServer(handle, lambda: None, lambda: None, Access()).serve_socket(tmp_path / "c"):
        answer = await asyncio.to_thread(ask_daemon, tmp_path / "c", {"request": "arm"})
    assert (answer["ok"], answer["code"], answer["exit_code"]) == (False, "ProgramError", 3)
    assert answer["advice"] == "correct the program"


def test_silent_daemon_is_a_timeout(tmp_path: Path, listener: socket.socket) -> None:
    with pytest.raises(DeviceTimeout, match="did not answer"):
        ask_daemon(tmp_path / "s", {"request": "status"}, timeout_s=0.05)


def test_hang_up_or_invalid_answer_of_the_daemon_is_reported(tmp_path: Path, listener: socket.socket) -> None:
    for answer in (b"", b"nonsense\n", b"[]\n"):

        def serve(answer: bytes = answer) -> None:
            peer, _ = listener.accept()
            with peer:
                peer.recv(1000)
                peer.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(ConnectError, match=r"without an answer|an invalid answer"):
            ask_daemon(tmp_path / "s", {"request": "status"})
        thread.join()


@pytest.mark.usefixtures("real_time")
async def test_long_check_reports_progress_and_ends_when_its_client_leaves(tmp_path: Path) -> None:
    turn = {"count": 0}
    free, abandoned = asyncio.Event(), asyncio.Event()

    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        await (abandoned if "of" in request else free).wait()
        return {"ok": True}

    def progress() -> Mapping[str, Any]:
        turn["count"] += 1
        if turn["count"] == 2:
            free.set()
        return {"checked_s": turn["count"]}

    result: list[Mapping[str, Any]] = []
    async with ControlServer(handle, progress, abandoned.set, Access()).serve_socket(tmp_path / "c"):
        answer = await asyncio.to_thread(ask_daemon, tmp_path / "c", {"request": "arm"}, 10.0, result.append)
        assert answer == {"ok": True}
        assert result == [{"checked_s": 1}, {"checked_s": 2}]
        with pytest.raises(DeviceTimeout):
            await asyncio.to_thread(ask_daemon, tmp_path / "c", {"request": "arm", "of": "one who leaves"}, 0.01)
        await asyncio.wait_for(abandoned.wait(), 30.0)  # also where no progress was asked for


async def asking(path: Path, *requests: Mapping[str, Any]) -> asyncio.StreamWriter:
    _, writer = await asyncio.open_unix_connection(str(path))
    writer.writelines(json.dumps(request).encode() + b"\n" for request in requests)
    return writer


@pytest.mark.fault("G1")
@pytest.mark.parametrize("role", [Role.NOBODY, Role.WATCH, Role.OPERATE])
async def test_check_progress_and_abandonment_belong_to_its_own_client(
    role: Role, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fdhil.daemon.daemon_socket.PROGRESS_S", 0.01)
    roles = iter([Role.OPERATE, role])
    monkeypatch.setattr(
        "fdhil.daemon.daemon_socket.identify_peer", lambda *_: ClientProcess("somebody", 4711, 1, next(roles))
    )
    received, free, abandoned = asyncio.Semaphore(0), asyncio.Event(), asyncio.Event()

    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        received.release()
        await free.wait()
        return {"ok": True}

    server = ControlServer(handle, lambda: {"program": "secret.ngc"}, abandoned.set, Access())
    async with server.serve_socket(tmp_path / "c"):
        operator = await asking(tmp_path / "c", {"request": "arm"})
        await received.acquire()
        reader, other = await asyncio.open_unix_connection(str(tmp_path / "c"))
        other.write(b'{"request": "arm", "progress": true}\n')
        await received.acquire()
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(reader.readline(), 0.3)
        other.close()
        await asyncio.sleep(0.3)
        assert (abandoned.is_set(), server.is_armer_gone) == (False, False)
        operator.close()
        await asyncio.wait_for(abandoned.wait(), 30.0)
        assert server.is_armer_gone
        free.set()
    assert not server.is_armer_gone


def test_client_without_descriptors_gets_an_explanation(tmp_path: Path, listener: socket.socket) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1, hard))
    try:
        with pytest.raises(ConnectError, match=r"could not be reached \(Too many open files\); close"):
            ask_daemon(tmp_path / "s", {"request": "status"})
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def test_arm_request_of_a_disconnected_client_is_abandoned(tmp_path: Path) -> None:
    received: list[str] = []

    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        received.append(f"{request['request']} {request['of']}")
        return {"ok": True}

    async with ControlServer(handle, dict, lambda: None, Access()).serve_socket(tmp_path / "c"):
        for kind in ("arm", "disarm", "stop"):
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:  # the server has no turn meanwhile
                client.connect(str(tmp_path / "c"))
                client.sendall(json.dumps({"request": kind, "of": "one who left"}).encode() + b"\n")
        reader, writer = await asyncio.open_unix_connection(str(tmp_path / "c"))
        writer.write(b'{"request": "arm", "of": "one who stays"}\n')
        writer.write_eof()
        assert json.loads(await reader.readline()) == {"ok": True}
        writer.close()
    assert received == ["disarm one who left", "stop one who left", "arm one who stays"]


async def test_idle_connections_make_room_and_pending_ones_leave_room_for_disarm(tmp_path: Path) -> None:
    free, waiting = asyncio.Event(), asyncio.Semaphore(0)

    async def handle(request: Mapping[str, Any], peer: ClientProcess) -> Mapping[str, Any]:
        if request["request"] == "arm":
            waiting.release()
            await free.wait()
        return {"ok": True}

    path = tmp_path / "c"
    idle: list[socket.socket] = []
    async with ControlServer(handle, lambda: None, free.set, Access()).serve_socket(path):
        for _ in range(3 * MAX_CLIENTS):
            idle.append(socket.socket(socket.AF_UNIX))
            idle[-1].connect(str(path))
        assert await asyncio.to_thread(ask_daemon, path, {"request": "disarm"}) == {"ok": True}
        assert await asyncio.to_thread(idle[0].recv, 1) == b""  # the longest idle made room
        idle[-1].setblocking(False)
        with pytest.raises(BlockingIOError):
            idle[-1].recv(1)
        arming = []
        for _ in range(MAX_CLIENTS + 1):
            reader, writer = await asyncio.open_unix_connection(str(path))
            writer.write(b'{"request": "arm"}\n')
            arming.append((reader, writer))
        for _ in range(MAX_CLIENTS):
            await asyncio.wait_for(waiting.acquire(), 60.0)
        assert b"Busy" in await asyncio.wait_for(arming[-1][0].readline(), 60.0)
        for request in ("disarm", "status", "disarm", "status", "disarm"):
            assert await asyncio.to_thread(ask_daemon, path, {"request": request}) == {"ok": True}
        free.set()
        for reader, writer in arming[:-1]:
            assert json.loads(await reader.readline()) == {"ok": True}
            writer.close()
        arming[-1][1].close()
    for each in idle:
        each.close()


@pytest.mark.parametrize("abstract", [False, True])
def test_notify_follows_the_systemd_protocol(abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        name = f"@fdhil-test-{tmp_path.name}-{os.getpid()}" if abstract else str(tmp_path / "notify")
        manager.bind(name.replace("@", "\0", 1) if abstract else name)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        assert notify_systemd("READY=1\nSTATUS=x")
        assert manager.recv(100) == b"READY=1\nSTATUS=x"


def test_notify_without_a_service_manager_does_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify_systemd("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "absent"))
    assert not notify_systemd("READY=1")


def test_every_outcome_is_one_line() -> None:
    assert format_outcome(make_outcome())[0] == "X: G0 + at 12.35 s (600 samples) accepted, fit 97.25 %"
    refused, severity = format_outcome(make_outcome(accepted=False))
    assert refused.endswith("refused, fit 97.25 %: MissingStage(cruise): no plateau")
    assert severity == "info"
    assert "revision 1 from 3 windows: R 0.5 ohm, L 0.005 H" in format_outcome(make_published())[0]
    assert "predicted within 0.25 um RMS" in format_outcome(Skill("X", 5, 0.25, 1.0, 0.0, 24.0))[0]
    assert format_outcome(Notice("LoadChanged", "MAJOR", "Jt rose", "X")) == ("X: LoadChanged: Jt rose", "MAJOR")


@pytest.mark.fault("G12")
def test_lines_carry_priorities_in_the_journal_and_no_escapes_anywhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    service_log.write_line("bad \x1b[31m\nforged", "MAJOR")
    monkeypatch.delenv("JOURNAL_STREAM")
    service_log.write_line("Öl µm", "info")
    line = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3} UTC Öl µm"
    assert re.fullmatch(rf"<3>bad \\x1b\[31m\\nforged\n{line}\n", capsys.readouterr().err)
    assert escape_unprintable("\u202e") == "\\u202e"


@pytest.mark.fault("F11")
@pytest.mark.timeout(60)
def test_unread_log_does_not_block_and_reports_dropped_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_log, "_dropped", {"lines": 0})
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb", 0) as read, os.fdopen(writer, "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        for _ in range(2_000):
            service_log.write_line("x" * 100)
        result = read.read(1 << 20).count(b"\n")
        service_log.write_line("last")
        lines = read.read(1 << 20).decode().splitlines()
        assert lines[0].endswith(f" {2_000 - result} lines could not be written before this one")
        assert lines[1].endswith(" last")
        read.close()
        service_log.write_line("said to nobody")
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        service_log.write_line("on a full disk")


@pytest.mark.fault("F12")
def test_flood_of_one_class_is_counted_and_suppresses_no_other() -> None:
    gate = LogThrottle()
    admitted = [gate.admit_line("A", 0.0) for _ in range(1000)]
    assert admitted[:BURST] == [0] * BURST
    assert admitted[BURST:] == [None] * (1000 - BURST)
    assert gate.admit_line("B", 0.0) == 0
    assert gate.admit_line("A", 1.5) == 1000 - BURST
    assert gate.admit_line("A", 1.5) is None


@pytest.mark.fault("F8")
def test_lock_is_released_when_its_owner_ends(tmp_path: Path) -> None:
    run, store = tmp_path / "run", tmp_path / "store"
    for _ in range(2):
        with lock_machine(run, store):
            for other_run, other_store in ((run, tmp_path / "other"), (tmp_path / "elsewhere", store)):
                with (
                    pytest.raises(BusLocked, match="nothing was sent") as error,
                    lock_machine(other_run, other_store),
                ):
                    pass
                assert error.value.exit_code == 3
    assert (tmp_path / "run").stat().st_mode & 0o777 == 0o700


def test_unusable_run_directory_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="run_directory"), lock_machine(tmp_path / "file" / "run", tmp_path):
        pass


def test_unusable_store_does_not_end_the_daemon(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with lock_machine(tmp_path / "run", tmp_path / "file"):
        pass


def test_token_is_created_once_and_private(tmp_path: Path) -> None:
    token = ensure_token(tmp_path)
    assert len(token) == 64
    assert ensure_token(tmp_path) == read_token(tmp_path) == token
    assert (tmp_path / "token").stat().st_mode & 0o777 == 0o600
    (tmp_path / "token").chmod(0o644)
    with pytest.raises(DeviceError, match="other users can read it"):
        read_token(tmp_path)


def test_failed_token_creation_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", refuses)
        with pytest.raises(DeviceError, match=r"token: cannot be written: No space left .* check"):
            ensure_token(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert len(ensure_token(tmp_path)) == 64


def test_concurrent_token_creation_gives_both_the_same_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = os.link

    def after_another(made: str, path: Path) -> None:
        monkeypatch.setattr(os, "link", link)
        ensure_token(tmp_path)
        link(made, path)

    monkeypatch.setattr(os, "link", after_another)
    assert ensure_token(tmp_path) == read_token(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["token"]


def test_guard_refuses_a_world_writable_folder(tmp_path: Path) -> None:
    get_operator_token(tmp_path / "run")
    (tmp_path / "run").chmod(0o777)
    for use in (get_operator_token, make_run_directory):
        with pytest.raises(DeviceError, match=r"any user may put a socket .* chmod 0700"):
            use(tmp_path / "run")


def test_empty_or_linked_token_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("secret")
    (tmp_path / "token").symlink_to(tmp_path / "elsewhere")
    for use in (ensure_token, read_token):
        with pytest.raises(DeviceError, match="cannot be read"):
            use(tmp_path)
    (tmp_path / "token").unlink()
    (tmp_path / "token").touch(0o600)
    with pytest.raises(DeviceError, match="is empty"):
        ensure_token(tmp_path)
    with pytest.raises(ConnectError, match="never run"):
        read_token(tmp_path / "absent")
