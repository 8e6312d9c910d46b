"""``fdhil-guard``: settings, refusals, and the transition to the guard process."""

from __future__ import annotations

import hashlib
import json
import os
import pwd
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from fdhil import config as machine_config
from fdhil.cli.bus_lock import lock_bus
from fdhil.cli.guard import guard
from fdhil.cli.main import cli, run_safely
from fdhil.commissioning.commissioning_record import compute_axis_digest, save_record
from fdhil.guard.guard_settings import load_settings
from fdhil.guard.offset_limits import OffsetLimits
from tests.arming.test_guard_configuration import RECORD
from tests.guard.drive_peer import Peer, hold_demand, write_config
from tests.reserved_port import reserve_port


def run_guard(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["fdhil-guard", *arguments])
    return run_safely(guard)


@pytest.fixture
def peer() -> Iterator[Peer]:
    with hold_demand() as made:
        yield made


def test_guard_help_exits_0(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_guard(monkeypatch, "--help") == 0
    text = capsys.readouterr().out
    assert "sends no frame until the daemon arms" in " ".join(text.split())


def test_check_writes_settings_and_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_config(tmp_path, 1)
    assert run_guard(monkeypatch, str(config), "--check") == 0
    assert "guard.json" in capsys.readouterr().out
    directory = tmp_path / "fdhil-data" / "run"
    settings = load_settings(directory / "guard.json")
    token = (directory / "token").read_text()
    assert stat.S_IMODE((directory / "token").stat().st_mode) == 0o600
    assert settings.token_sha256 == hashlib.sha256(token.encode()).hexdigest()
    assert token not in (directory / "guard.json").read_text()
    assert settings.sent_ids == {0x301, 0x302, 0x764}
    assert [axis.name for axis in settings.axes] == ["X", "Y"]
    assert settings.axes[0].limits == OffsetLimits(819, 65, 6, 9830, 1000)
    assert settings.axes[1].target.cob_id == 0x202
    assert settings.axes[0].window == 32768


def test_guard_refuses_machine_without_correction_section(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_config(tmp_path, 1, corrected=False)
    assert run_guard(monkeypatch, str(config)) == 2
    assert "writing is off" in capsys.readouterr().err


def test_missing_hub_is_reported_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with reserve_port() as port:
        assert run_guard(monkeypatch, str(write_config(tmp_path, port))) == 3
    reported = capsys.readouterr().err
    assert "start the hub first" in reported
    assert len(reported.splitlines()) == 1


def test_commissioning_is_refused_while_guard_owns_bus(
    tmp_path: Path, peer: Peer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The running guard read the records at its start and would not use a new one."""
    config = write_config(tmp_path, peer.port)
    monkeypatch.setattr(sys, "argv", ["fdhil", "commission", str(config), "--yes"])
    with lock_bus(machine_config.load_config(config).bus["can0"]):
        assert run_safely(cli) == 3
    assert "BusLocked" in capsys.readouterr().err


def fail_if_called(*_: object) -> None:
    raise AssertionError("a second guard")


@pytest.mark.usefixtures("processes")
def test_guard_process_owns_bus_and_stops_cleanly(
    tmp_path: Path, peer: Peer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second guard on another name of the same hub exits with 3 and sends nothing."""
    config = write_config(tmp_path, peer.port)
    (tmp_path / "other").mkdir()
    other = write_config(tmp_path / "other", peer.port)
    other.write_text(other.read_text().replace("127.0.0.1", "localhost"))
    command = [sys.executable, "-m", "fdhil.cli.guard", str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        monkeypatch.setattr(os, "execv", fail_if_called)
        try:
            seconds = [(run_guard(monkeypatch, str(again)), capsys.readouterr().err) for again in (config, other)]
        finally:
            process.send_signal(signal.SIGTERM)
        reported = [json.loads(line) for line in process.stdout]
        assert process.wait(300) == 0
        assert reported[-1]["event"] == "stopped"
    assert (ready["event"], ready["axes"]) == ("ready", ["X", "Y"])
    assert [code for code, _ in seconds] == [3, 3]
    assert all("BusLocked" in refused and len(refused.splitlines()) == 1 for _, refused in seconds)
    assert peer.sent == []


@pytest.mark.usefixtures("processes")
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_guard_with_closed_stdout_sends_nothing_on_bus(closed: str, tmp_path: Path, peer: Peer) -> None:
    """Otherwise the bus would get the descriptor of stdout, and log lines would be sent on it."""
    config = write_config(tmp_path, peer.port)
    command = f"exec {sys.executable} -m fdhil.cli.guard {config} {closed}"
    with subprocess.Popen(["bash", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        deadline_s = time.monotonic() + 300
        while not (tmp_path / "fdhil-data" / "run" / "guard.sock").exists():
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        held = {number: str(Path(f"/proc/{process.pid}/fd/{number}").readlink()) for number in range(3)}
        process.send_signal(signal.SIGTERM)
        _, reported = process.communicate()
    assert not any(where.startswith("socket:") for where in held.values()), held
    assert reported == b""
    assert peer.sent == []


@pytest.mark.usefixtures("processes")
def test_guard_process_refuses_invalid_settings(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fdhil.guard", "--settings", str(tmp_path / "none.json"), "--descriptor", "0"]
    refused = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert refused.returncode == 2
    assert "run fdhil-guard" in refused.stderr
    assert len(refused.stderr.splitlines()) == 1


def test_guard_runs_under_separate_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The guard has its own directory, gets the token from systemd, and accepts the daemon's user."""
    config = write_config(tmp_path, 1)
    config.write_text(config.read_text() + 'run_directory = "own"\ndaemon_user = "daemon"\n')
    given = tmp_path / "credentials"
    given.mkdir()
    (given / "token").write_text("the operator's")
    (given / "token").chmod(0o400)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(given))
    key = given / "commissioning.key"
    key.write_text("5e" * 32)
    key.chmod(0o400)
    machine = machine_config.load_config(config)
    save_record(replace(RECORD, config_digest=compute_axis_digest(machine, "X")), machine.store.directory, key)
    assert run_guard(monkeypatch, str(config), "--check") == 0
    settings = load_settings(tmp_path / "own" / "guard.json")
    assert settings.token_sha256 == hashlib.sha256(b"the operator's").hexdigest()
    assert settings.daemon_uid == pwd.getpwnam("daemon").pw_uid
    assert settings.run_directory == str(tmp_path / "own")
    assert stat.S_IMODE((tmp_path / "own" / "guard.json").stat().st_mode) == 0o600
    assert settings.axes[0].record, "its key came from systemd too"
    assert not (tmp_path / "fdhil-data" / "run").exists()
    config.write_text(config.read_text().replace('"daemon"', '"nobody of that name"'))
    assert run_guard(monkeypatch, str(config), "--check") == 2
    assert "the user 'nobody of that name' does not exist" in capsys.readouterr().err
