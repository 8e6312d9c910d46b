"""Shortens the waiting times of commissioning for drives simulated in this process.

On a real bus commissioning listens for seconds before it sends; a simulated drive answers at once.
"""

from __future__ import annotations

import pytest

SHORT_WAITS: dict[str, float] = {
    "commissioning.scan.LISTEN_S": 0.05,
    "commissioning.config_check.LISTEN_S": 0.05,
    "commissioning.drive_survey.LISTEN_S": 0.05,
    "commissioning.transmit.LOOK_S": 0.01,
    "cli.operator_prompt.LOOK_S": 0.01,
    "drivers.can.bus_listener.POLL_S": 0.01,
    "drivers.can.sdo_channel.QUIET_S": 0.05,
    "commissioning.commissioning_steps.SETTLE_CYCLES": 120,
    "commissioning.commissioning_steps.AVERAGE_CYCLES": 60,
}


def shorten_waits(monkeypatch: pytest.MonkeyPatch, others: dict[str, float] | None = None) -> None:
    """Set ``SHORT_WAITS``, and ``others`` by the same names, during a test."""
    for name, value in {**SHORT_WAITS, **(others or {})}.items():
        monkeypatch.setattr(f"fdhil.{name}", value)
