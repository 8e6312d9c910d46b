"""Fixtures shared by the tests on real interfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fdhil.guard.can_socket import RawCan
from tests.guard import guard_rig as guard_shop
from tests.guard.guard_rig import GuardRig
from tests.socketcan.interface import set_up


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[type[RawCan]], GuardRig]]:
    made: list[GuardRig] = []

    def build(wire: type[RawCan]) -> GuardRig:
        monkeypatch.setattr(guard_shop, "Wire", wire)
        made.append(GuardRig(tmp_path))
        return made[-1]

    yield build
    set_up("vcan0", True)
    for shop in made:
        shop.close()
