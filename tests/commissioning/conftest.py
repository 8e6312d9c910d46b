"""What the tests of commissioning share."""

from __future__ import annotations

import pytest

from fdhil.commissioning import steps as commissioning
from fdhil.commissioning import survey as commissioning_checks
from fdhil.drivers.can import sdo as canopen_sdo


@pytest.fixture
def quick_commissioning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter waits than on a real machine; the simulated drive settles sooner."""
    monkeypatch.setattr(commissioning_checks, "LISTEN_S", 0.25)
    monkeypatch.setattr(canopen_sdo, "QUIET_S", 0.1)
    monkeypatch.setattr(canopen_sdo, "RESPONSE_TIMEOUT_S", 0.2)
    monkeypatch.setattr(commissioning, "SETTLE_CYCLES", 120)
    monkeypatch.setattr(commissioning, "AVERAGE_CYCLES", 60)
