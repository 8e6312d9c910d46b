"""Asks a sensor that shows one value, its newest, again and again, and says when each value was true.

A sensor that is asked is asked on a grid of instants of this computer's clock, so that its values are a signal with a
rate; one that tells by itself keeps its own rate. A value that was not to be had in time is a hole in the count and is
never put in another's place.
"""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.link import Link
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import Notice, VoltageSamples, frozen, frozen_ints

GATHER_S = 0.05  # values are handed over together, as often as other sensors are asked
SYNC_LATENESS_NS = 200_000  # how late the stamp of a SYNC may be on a busy computer
BEYOND_LIMIT = 4.0  # no terminal voltage is so many times what the drive can give
TOLD_AFTER = 200  # values
LOST_SHARE = 0.1


class Meter(Protocol):
    """A sensor that shows one value. ``asked_ns`` and ``answered_ns`` (host-monotonic) enclose when the last one was
    true, but for what its own filter takes; ``tells_by_itself`` where it is not asked."""

    asked_ns: int
    answered_ns: int
    tells_by_itself: bool

    @property
    def link(self) -> Link:
        """Its connection."""

    async def value(self) -> float:
        """Return its newest value, scaled; DeviceError."""

    def doubt(self, shown: str) -> str:
        """Return what is to be told of a value that cannot be: where it stands, and what to compare."""


@dataclass(frozen=True, slots=True)
class _Value:
    """A value, its number on the grid, when it was true and how far off that may be (ns)."""

    number: int
    value: float
    t_ns: float
    error_ns: float


class MeterVoltage:
    """The voltage of one axis as a ``meter`` shows it."""

    def __init__(self, axis: str, config: MachineConfig, meter: Meter) -> None:
        section = config.axis[axis]
        settings = section.voltage
        self.axis = axis
        self.name = f"voltage sensor {axis}"
        self._meter = meter
        self._sign = section.drive.sign
        self._limit_v = BEYOND_LIMIT * section.regulators.voltage_limit_v
        self._period_ns = settings.period_s * 1e9
        self._late_ns = (settings.delay_s + settings.renewed_s / 2) * 1e9
        if settings.sampling == "interval_mean":
            self._late_ns += self._period_ns  # a sample is placed where its interval begins
        self._renewed_ns = settings.renewed_s * 1e9
        self._together = math.ceil(GATHER_S / settings.period_s) + 1
        self._origin_ns: float | None = None
        self._next = 0
        self._told_lost = False
        self.samples = self.lost = 0

    @property
    def link(self) -> Link:
        """The meter's connection."""
        return self._meter.link

    async def poll(self, ticks: TickClock) -> list[VoltageSamples | Notice]:
        """Ask for some values, one after the other; DeviceError when none came."""
        found: list[_Value] = []
        for left in range(self._together - 1, -1, -1):
            try:
                value = await (self._told() if self._meter.tells_by_itself else self._asked())
                found += [value] if value is not None else []
            except DeviceError as error:
                ended = isinstance(error, ConnectError | DeviceTimeout)
                if (ended or not left) and not found:
                    raise
                if ended:
                    break
        out: list[VoltageSamples | Notice] = [*self._too_slow()]
        return [*out, self._samples(found, ticks)] if found else out

    async def reading(self) -> str:
        """Ask once, for people."""
        return f"{await self._volts():.2f} V at {1e9 / self._period_ns:g} Hz"

    async def _asked(self) -> _Value | None:
        """Wait for the next instant of the grid and ask; None where the answer was too late for it."""
        now_ns = time.monotonic_ns()
        if self._origin_ns is None:
            self._origin_ns = now_ns
        number = max(self._next, math.ceil((now_ns - self._origin_ns) / self._period_ns))
        self.lost += number - self._next
        self._next = number + 1
        due_ns = self._origin_ns + number * self._period_ns
        await asyncio.sleep(max(0.0, (due_ns - now_ns) / 1e9))
        try:
            volts = await self._volts()
        except DeviceError:
            self.lost += 1
            raise
        late_ns = self._meter.asked_ns - due_ns
        if late_ns > self._period_ns / 2:  # another on the line was asked first
            self.lost += 1
            return None
        return self._placed(number, volts, max(0.0, late_ns))

    async def _told(self) -> _Value:
        """Wait for the next value that is told; what was missed meanwhile is a hole."""
        volts = await self._volts()
        t_ns = self._meter.answered_ns
        if self._origin_ns is not None:
            missed = max(0, round((t_ns - self._origin_ns) / self._period_ns) - 1)
            self.lost += missed
            self._next += missed
        self._origin_ns = t_ns
        self._next += 1
        return self._placed(self._next - 1, volts, 0.0)

    def _placed(self, number: int, volts: float, late_ns: float) -> _Value:
        meter = self._meter
        middle_ns = (meter.asked_ns + meter.answered_ns) / 2
        error_ns = (meter.answered_ns - meter.asked_ns) / 2 + self._renewed_ns / 2 + late_ns
        return _Value(number, volts, middle_ns - self._late_ns, error_ns)

    async def _volts(self) -> float:
        volts = await self._meter.value()
        if not abs(volts) <= self._limit_v:  # nor is it NaN
            raise ProtocolError(self.name, self._meter.doubt(f"{volts:g} V"))
        return volts

    def _too_slow(self) -> list[Notice]:
        """Tell once that the sensor cannot be asked as often as the config has it."""
        if self._told_lost or self._next < TOLD_AFTER or self.lost < LOST_SHARE * self._next:
            return []
        self._told_lost = True
        took_ms = (self._meter.answered_ns - self._meter.asked_ns) / 1e6
        text = f"Of {self._next} values of the {self.name} {self.lost} did not come in time (an answer takes "
        text += f"{took_ms:.1f} ms), and a move with such a hole may be refused; set axis.{self.axis}.voltage.period_s "
        text += f"above {self._period_ns / 1e9:g}."
        return [Notice("SampleTiming", "minor", text, self.axis)]

    def _samples(self, found: list[_Value], ticks: TickClock) -> VoltageSamples:
        self.samples += len(found)
        sync_ns = SYNC_LATENESS_NS if ticks.running else 0
        return VoltageSamples(
            sensor=self.name,
            axis=self.axis,
            counter=frozen_ints(np.array([one.number for one in found])),
            t_ns=frozen_ints(np.array([round(one.t_ns) for one in found])),
            t_error_ns=frozen_ints(np.array([max(1, round(one.error_ns + sync_ns)) for one in found])),
            voltage_v=frozen(self._sign * np.array([one.value for one in found])),
            sample_rate_hz=1e9 / self._period_ns,
        )
