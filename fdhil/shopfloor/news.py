"""Asks the daemon how it is, again and again, and says what is to be told: values, alarms, and what is new.

A daemon that does not answer is told of as well; it is asked on.
"""

import asyncio
import math
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Any

from fdhil.config import MachineConfig
from fdhil.daemon import journal
from fdhil.daemon.control import SOCKET_NAME, ask
from fdhil.errors import DeviceError
from fdhil.shopfloor.published import Alarm, Event, Value, alarms, events, published

ANSWER_S = 10.0
SAME_S = 0.002  # the daemon tells its times in ms


@dataclass(frozen=True, slots=True)
class News:
    """What one answer of the daemon says. ``silent`` is why there is none, and then no value is known.

    ``events`` are those that came since the answer before; what was there before the first answer is no news.
    """

    values: tuple[Value, ...]
    alarms: tuple[Alarm, ...]
    events: tuple[Event, ...]
    stamp_ms: int
    silent: str = ""


class Listener:
    """Remembers which of the daemon's notices were told."""

    def __init__(self, config: MachineConfig) -> None:
        self._axes, self._buses = tuple(config.axis), buses(config)
        self._uptime_s: float | None = None
        self._told_s = -math.inf

    def news(self, status: Mapping[str, Any] | None, now_ms: int, silent: str = "") -> News:
        """Return the news of a status that came just now; None: the daemon is silent, and why."""
        found = published(self._axes, self._buses, status, now_ms)
        new = () if status is None else self._new(status, now_ms)
        return News(found, alarms(status), new, now_ms, silent)

    def _new(self, status: Mapping[str, Any], now_ms: int) -> tuple[Event, ...]:
        first, uptime_s = self._uptime_s is None, float(status["uptime_s"])
        if self._uptime_s is not None and uptime_s < self._uptime_s:
            self._told_s = -math.inf  # another daemon than the one before
        self._uptime_s = uptime_s
        new = tuple(event for event in events(status, now_ms) if event.uptime_s > self._told_s + SAME_S)
        if new:
            self._told_s = new[-1].uptime_s
        return () if first else new


def buses(config: MachineConfig) -> tuple[str, ...]:
    """Return the buses that have drives of an axis, in the order of the axes."""
    return tuple(dict.fromkeys(axis.drive.bus for axis in config.axis.values()))


async def listen(config: MachineConfig, period_s: float) -> AsyncIterator[News]:
    """Ask the daemon every ``period_s``, for ever, and yield what it says."""
    listener, path, told = Listener(config), config.run_directory / SOCKET_NAME, ""
    while True:
        began_s = time.monotonic()
        status, silent = None, ""
        try:
            answer = await asyncio.to_thread(ask, path, {"request": "status"}, ANSWER_S)
            status = answer if answer.get("ok") else None
            silent = "" if status else f"the daemon refuses: {answer.get('text')}"
        except DeviceError as error:
            silent = str(error)
        if silent != told:
            journal.write_line(f"{silent}; no value is known meanwhile" if silent else "the daemon answers")
            told = silent
        yield listener.news(status, time.time_ns() // 1_000_000, silent)
        await asyncio.sleep(max(0.0, period_s - (time.monotonic() - began_s)))
