"""Fixtures shared by the tests on real interfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fdhil.guard.can_socket import RawCan
from tests.guard import shop as guard_shop
from tests.guard.shop import Shop
from tests.socketcan.interface import set_up


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[type[RawCan]], Shop]]:
    made: list[Shop] = []

    def build(wire: type[RawCan]) -> Shop:
        monkeypatch.setattr(guard_shop, "Wire", wire)
        made.append(Shop(tmp_path))
        return made[-1]

    yield build
    set_up("vcan0", True)
    for shop in made:
        shop.close()
