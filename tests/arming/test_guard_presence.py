"""A guard is present if a process listens at its socket; the socket file alone does not count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from fdhil.arming.guard_presence import GuardPresence
from tests.arming.guard_peer import Guard


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now_s = [100.0]
    monkeypatch.setattr("fdhil.arming.guard_presence.time", SimpleNamespace(monotonic=lambda: now_s[0]))
    return now_s


def test_guard_is_there_while_it_listens_and_a_moment_longer(tmp_path: Path, clock: list[float]) -> None:
    presence, guard = GuardPresence(tmp_path), Guard(tmp_path)
    assert presence.is_there()
    (tmp_path / "guard.sock").unlink()  # cleaned away: it makes it again
    clock[0] += 2.0
    assert presence.is_there()
    guard.close()
    clock[0] += 2.0
    assert not presence.is_there()


def test_socket_that_a_killed_guard_left_is_no_guard(tmp_path: Path, clock: list[float]) -> None:
    presence = GuardPresence(tmp_path)
    assert not presence.is_there()
    Guard(tmp_path).close()
    clock[0] += 2.0
    assert (tmp_path / "guard.sock").exists()
    assert not presence.is_there()


def test_guard_that_starts_is_noticed(tmp_path: Path, clock: list[float]) -> None:
    presence = GuardPresence(tmp_path)
    assert not presence.is_there()
    guard = Guard(tmp_path)
    clock[0] += 2.0
    assert presence.is_there()
    guard.close()
