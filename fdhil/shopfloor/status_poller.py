"""Polls the daemon's status and yields what is to be published: values, alarms, and new events.

While the daemon does not respond, no values are published; polling continues.
"""

import asyncio
import math
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Any

from fdhil.config import MachineConfig
from fdhil.daemon import SOCKET_NAME, ask_daemon, write_line
from fdhil.errors import DeviceError
from fdhil.shopfloor.published_items import (
    PublishedAlarm,
    PublishedEvent,
    PublishedValue,
    list_alarms,
    list_events,
    list_published_values,
)

ANSWER_S = 10.0
SAME_S = 0.002  # the daemon's times are in ms


@dataclass(frozen=True, slots=True)
class StatusUpdate:
    """Content of one answer of the daemon. ``silent`` is the reason for a missing answer; then no value is known.

    ``events`` are those since the previous answer; events before the first answer are not new.
    """

    values: tuple[PublishedValue, ...]
    alarms: tuple[PublishedAlarm, ...]
    events: tuple[PublishedEvent, ...]
    stamp_ms: int
    silent: str = ""


class StatusPoller:
    """Tracks which of the daemon's notices were published."""

    def __init__(self, config: MachineConfig) -> None:
        self._axes, self._buses = tuple(config.axis), list_buses(config)
        self._uptime_s: float | None = None
        self._published_s = -math.inf

    def build_update(self, status: Mapping[str, Any] | None, now_ms: int, silent: str = "") -> StatusUpdate:
        """Return the update of a status received now; None: the daemon does not respond, ``silent`` is the reason."""
        found = list_published_values(self._axes, self._buses, status, now_ms)
        new = () if status is None else self._select_new_events(status, now_ms)
        return StatusUpdate(found, list_alarms(status), new, now_ms, silent)

    def _select_new_events(self, status: Mapping[str, Any], now_ms: int) -> tuple[PublishedEvent, ...]:
        first, uptime_s = self._uptime_s is None, float(status["uptime_s"])
        if self._uptime_s is not None and uptime_s < self._uptime_s:
            self._published_s = -math.inf  # the daemon was restarted
        self._uptime_s = uptime_s
        new = tuple(event for event in list_events(status, now_ms) if event.uptime_s > self._published_s + SAME_S)
        if new:
            self._published_s = new[-1].uptime_s
        return () if first else new


def list_buses(config: MachineConfig) -> tuple[str, ...]:
    """Return the buses that have drives of an axis, in the order of the axes."""
    return tuple(dict.fromkeys(axis.drive.bus for axis in config.axis.values()))


async def poll_status(config: MachineConfig, period_s: float) -> AsyncIterator[StatusUpdate]:
    """Request the daemon's status every ``period_s``, for ever, and yield updates."""
    listener, path, logged = StatusPoller(config), config.run_directory / SOCKET_NAME, ""
    while True:
        began_s = time.monotonic()
        status, silent = None, ""
        try:
            answer = await asyncio.to_thread(ask_daemon, path, {"request": "status"}, ANSWER_S)
            status = answer if answer.get("ok") else None
            silent = "" if status else f"the daemon refuses: {answer.get('text')}"
        except DeviceError as error:
            silent = str(error)
        if silent != logged:
            write_line(f"{silent}; no values are published meanwhile" if silent else "the daemon answers")
            logged = silent
        yield listener.build_update(status, time.time_ns() // 1_000_000, silent)
        await asyncio.sleep(max(0.0, period_s - (time.monotonic() - began_s)))
