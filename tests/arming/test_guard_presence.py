"""A guard is present if a process listens at its socket; the socket file alone does not count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from fdhil.arming.guard_presence import GuardPresence
from tests.arming.guard_peer import GuardPeer


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now_s = [100.0]
    monkeypatch.setattr("fdhil.arming.guard_presence.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    return now_s


def test_guard_is_present_while_listening_and_briefly_after(tmp_path: Path, clock: list[float]) -> None:
    presence, guard = GuardPresence(tmp_path), GuardPeer(tmp_path)
    assert presence.is_present()
    (tmp_path / "guard.sock").unlink()  # cleaned away: it makes it again
    clock[0] += 2.0
    assert presence.is_present()
    guard.close()
    clock[0] += 2.0
    assert not presence.is_present()


def test_socket_of_killed_guard_is_not_present(tmp_path: Path, clock: list[float]) -> None:
    presence = GuardPresence(tmp_path)
    assert not presence.is_present()
    GuardPeer(tmp_path).close()
    clock[0] += 2.0
    assert (tmp_path / "guard.sock").exists()
    assert not presence.is_present()


def test_started_guard_is_detected(tmp_path: Path, clock: list[float]) -> None:
    presence = GuardPresence(tmp_path)
    assert not presence.is_present()
    guard = GuardPeer(tmp_path)
    clock[0] += 2.0
    assert presence.is_present()
    guard.close()
