"""The daemon's end of the guard's socket, and the start of the guard's process."""

from __future__ import annotations

import contextlib
import os
import runpy
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fdhil.arming.guard_client import GuardClient, GuardLost
from fdhil.errors import ConnectError, DeviceTimeout
from fdhil.guard import __main__ as entry
from fdhil.guard import stop_signals
from fdhil.guard.guard_settings import encode_settings
from fdhil.guard.request_parsing import parse_line
from tests.guard.simulated_bus import settings


@pytest.fixture
def scripted_guard(tmp_path: Path) -> Iterator[Callable[[bytes | None], GuardClient]]:
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    server.bind(str(tmp_path / "guard.sock"))
    server.listen()
    threads: list[threading.Thread] = []
    clients: list[GuardClient] = []

    def serve(answer: bytes | None) -> None:
        peer, _ = server.accept()
        with peer, contextlib.suppress(ConnectionError):
            while peer.recv(1 << 16) and answer is not None:
                peer.sendall(answer)

    def build(answer: bytes | None) -> GuardClient:
        threads.append(threading.Thread(target=serve, args=(answer,)))
        threads[-1].start()
        clients.append(GuardClient(tmp_path, timeout_s=0.05 if answer == b"" else 20.0))
        return clients[-1]

    yield build
    for client in clients:
        client.close()
    for thread in threads:
        thread.join()
    server.close()


Far = Callable[[bytes | None], GuardClient]


def test_missing_guard_is_reported_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ConnectError, match="start fdhil-guard"):
        GuardClient(tmp_path)


def test_answers_to_other_requests_are_skipped(scripted_guard: Far) -> None:
    client = scripted_guard(b'[]\n{"id": 99, "ok": false}\n{"id": 1, "ok": true, "state": "OFF"}\n')
    assert client.read_status() == {"ok": True, "state": "OFF"}


def test_silent_guard_is_reported(scripted_guard: Far) -> None:
    with pytest.raises(DeviceTimeout, match="did not answer"), scripted_guard(b"") as client:
        client.disarm()


def test_closed_connection_is_guard_lost(scripted_guard: Far) -> None:
    client = scripted_guard(None)
    with pytest.raises(GuardLost, match="is gone"):
        client.adopt("token")
    with pytest.raises(GuardLost, match="is gone"):
        send_alive_forever(client)


def send_alive_forever(client: GuardClient) -> None:
    while True:
        client.send_alive({"model_fresh": True})


def test_broken_connection_is_guard_lost(scripted_guard: Far, monkeypatch: pytest.MonkeyPatch) -> None:
    client = scripted_guard(b"")
    client._timeout_s = 20.0
    client._socket.shutdown(socket.SHUT_RD)
    with pytest.raises(GuardLost):
        client.arm("token", "digest", {})

    class Broken:
        def settimeout(self, seconds: float) -> None: ...
        def sendall(self, line: bytes) -> None: ...
        def close(self) -> None: ...
        def fileno(self) -> int:
            return ready

        def recv(self, size: int) -> bytes:
            raise OSError(104, "Connection reset by peer")

    client._socket.close()
    monkeypatch.setattr(client, "_socket", Broken())
    ready = os.open(os.devnull, os.O_RDONLY)
    with pytest.raises(GuardLost, match="reset"):
        client.enable_feedforward("token", {"X": {}}, {})
    os.close(ready)


def test_table_is_sent_with_its_descriptor(scripted_guard: Far) -> None:
    client = scripted_guard(b'{"id": 1, "ok": true}\n{"id": 2, "ok": true}\n')
    assert client.report_comparison("token", {"X": "fingerprint"}, {"X": 0})["ok"]
    before = len(list(Path("/proc/self/fd").iterdir()))
    assert client.load_table("X", {"X": [1, 2]}, {"X": [0, 0]}, "digest") == {"ok": True}
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    client.send_alive()


@pytest.mark.parametrize(
    "line", [b"", b"NaN", b'{"a": Infinity}', b"[" * 20_000, b"\xff", b"[]", b'{"a": ' + b"9" * 5000 + b"}"]
)
def test_invalid_request_is_refused(line: bytes) -> None:
    assert parse_line(line) is None


@pytest.mark.parametrize(
    "mark", ["NaN", "[]", "1.5", "1e999", "-9007199254740993", "true", "null", '"' + "x" * 201 + '"']
)
def test_mark_that_cannot_be_restored_is_ignored(mark: str) -> None:
    assert "id" not in (parse_line(f'{{"id": {mark}}}'.encode()) or {})


def start_guard(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["fdhil.guard", *arguments])
    return entry.main()


def test_guard_starts_on_descriptor_and_stops_at_signal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, handlers: None
) -> None:
    file = tmp_path / "guard.json"
    file.write_text(encode_settings(settings(run_directory=str(tmp_path), clock="monotonic")))
    caught = stop_signals.catch_signals

    def catch_and_raise() -> socket.socket:
        wake = caught()
        for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP, signal.SIGRTMAX, 32, 33):
            os.kill(os.getpid(), number)
        return wake

    monkeypatch.setattr(stop_signals, "catch_signals", catch_and_raise)
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        assert start_guard(monkeypatch, "--settings", str(file), "--descriptor", str(near.detach())) == 3


def test_missing_settings_or_descriptor_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], handlers: None
) -> None:
    file = tmp_path / "guard.json"
    assert start_guard(monkeypatch, "--settings", str(file), "--descriptor", "0") == 2
    file.write_text(encode_settings(settings(run_directory=str(tmp_path))))
    assert start_guard(monkeypatch, "--settings", str(file), "--descriptor", str(1 << 20)) == 3
    reported = capsys.readouterr().err.splitlines()
    assert "run fdhil-guard" in reported[0]
    assert "start the guard with fdhil-guard" in reported[1]
    with pytest.raises(SystemExit, match="3"):
        runpy.run_path(str(entry.__file__), run_name="__main__")


def test_unknown_system_call_numbers_skip_two_signals(monkeypatch: pytest.MonkeyPatch, handlers: None) -> None:
    monkeypatch.setattr(stop_signals, "SIGACTION", {})
    wake = stop_signals.catch_signals()
    signal.raise_signal(signal.SIGQUIT)
    assert wake.recv(10) == bytes([signal.SIGQUIT])
    wake.close()
