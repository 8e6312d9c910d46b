"""Creates the standard OPC UA nodes once for all tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from fdhil.shopfloor.opcua_access import ReadOnlyServer
from tests.drivers.nc.opcua_peer import load_once


@pytest.fixture(autouse=True, scope="module")
def _share_standard_nodes() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ReadOnlyServer, "load_standard_address_space", load_once)
        yield
