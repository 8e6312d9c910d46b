"""What the tests of commissioning share."""

from __future__ import annotations

import pytest


@pytest.fixture
def quick_commissioning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter waits than on a real machine; the simulated drive settles sooner."""
    monkeypatch.setattr("fdhil.commissioning.survey.LISTEN_S", 0.25)
    monkeypatch.setattr("fdhil.commissioning.transmit.LOOK_S", 0.05)
    monkeypatch.setattr("fdhil.cli.consent.LOOK_S", 0.05)
    monkeypatch.setattr("fdhil.drivers.can.sdo.QUIET_S", 0.1)
    monkeypatch.setattr("fdhil.drivers.can.sdo.RESPONSE_TIMEOUT_S", 5.0)  # it answers at once, on a host that has time
    monkeypatch.setattr("fdhil.commissioning.steps.SETTLE_CYCLES", 120)
    monkeypatch.setattr("fdhil.commissioning.steps.AVERAGE_CYCLES", 60)
