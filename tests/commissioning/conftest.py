"""Fixtures shared by the commissioning tests."""

from __future__ import annotations

import pytest

from tests.short_waits import shorten_waits


@pytest.fixture
def fast_commissioning(virtual_threads: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run on virtual time with shorter waits than on a real machine, since the simulated drive settles sooner."""
    shorten_waits(monkeypatch)
