"""Polls a sensor that shows one value, its newest, and determines when each value was true.

A polled sensor is read on a schedule, so that its values form a signal with a rate; a free-running one keeps its own
rate. A value that did not come in time is a gap in the count and is never replaced by another.
"""

import asyncio
import math
import time
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fdhil.config import MachineConfig
from fdhil.drivers.asking_grid import AskingGrid
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.link import Link
from fdhil.drivers.told_count import ToldCount
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, ProtocolError
from fdhil.records import Notice, VoltageSamples, freeze_array, freeze_integers

GATHER_S = 0.05  # values are handed over together, as often as other sensors are polled
SYNC_LATENESS_NS = 200_000  # delay of a SYNC's stamp on a busy computer
BEYOND_LIMIT = 4.0  # multiple of the drive's voltage that no terminal voltage reaches
TOLD_AFTER = 200  # values
LOST_SHARE = 0.1
TIMELY_NS = 2_000_000  # an accelerating drive's voltage changes by 1 V per ms, which limits the error
SETTLED_NS = 50_000_000  # later SYNCs that are needed to recognise late stamps around an answer
IN_ORDER = 0.4  # of a period
MOST_WAITING = 1000
NEAR_S = 0.02


class Meter(Protocol):
    """A sensor that shows one value. ``asked_ns`` and ``answered_ns`` (host-monotonic) enclose the time at which the
    last one was true, apart from its filter; ``is_free_running`` where it is not polled."""

    asked_ns: int
    answered_ns: int
    tells_by_itself: bool

    @property
    def link(self) -> Link:
        """Its connection."""

    async def value(self) -> float:
        """Return its newest value, scaled; DeviceError."""

    def doubt(self, shown: str) -> str:
        """Describe an implausible value: where it was read, and what to compare."""


@dataclass(frozen=True, slots=True)
class _Value:
    number: int
    volts: float
    asked_ns: int
    answered_ns: int


class MeterVoltage:
    """The voltage of one axis from a ``meter``."""

    def __init__(self, axis: str, config: MachineConfig, meter: Meter) -> None:
        section = config.axis[axis]
        settings = section.voltage
        self.axis = axis
        self.name = f"voltage sensor {axis}"
        self._meter = meter
        self._sign = section.drive.sign
        self._limit_v = BEYOND_LIMIT * section.regulators.voltage_limit_v
        self._grid = AskingGrid(settings.period_s, config.machine.sync_period_s, _turn(axis, config))
        self._told = ToldCount(settings.period_s)
        self._late_ns = (settings.delay_s + settings.renewed_s / 2) * 1e9
        self._mean = settings.sampling == "interval_mean"
        if self._mean:
            self._late_ns += self._grid.period_ns  # a sample is placed at the beginning of its interval
        self._renewed_ns = settings.renewed_s * 1e9
        self._together = math.ceil(GATHER_S / settings.period_s) + 1
        self._waiting: deque[_Value] = deque(maxlen=MOST_WAITING)
        self._asked = self._holes = 0
        self._newest = -1
        self._told_holes = False
        self.samples = 0

    @property
    def link(self) -> Link:
        return self._meter.link

    @property
    def lost(self) -> int:
        return self._holes + self._grid.missed + self._told.missed

    async def poll(self, ticks: TickClock) -> list[VoltageSamples | Notice]:
        """Read some values, one after the other, and return those whose time is settled; DeviceError when none came."""
        came = False
        for left in range(self._together - 1, -1, -1):
            try:
                self._waiting.append(await (self._hear() if self._meter.tells_by_itself else self._ask(ticks)))
                came = True
            except DeviceError as error:
                ended = isinstance(error, ConnectError | DeviceTimeout)
                if (ended or not left) and not came:
                    raise
                if ended:
                    break
        return [*self._too_slow(), *self._placed(ticks)]

    async def reading(self) -> str:
        return f"{await self._volts():.2f} V at {1e9 / self._grid.period_ns:g} Hz"

    async def _ask(self, ticks: TickClock) -> _Value:
        number, due_ns = self._grid.next_instant(time.monotonic_ns(), ticks)
        while (left_s := (due_ns - time.monotonic_ns()) / 1e9) > 0:
            await asyncio.sleep(min(left_s, NEAR_S))
            due_ns = self._grid.host_ns(number, ticks)  # more accurate by the SYNCs that arrived meanwhile
        self._asked += 1
        try:
            volts = await self._volts()
        except DeviceError:
            self._holes += 1
            raise
        return _Value(number, volts, self._meter.asked_ns, self._meter.answered_ns)

    async def _hear(self) -> _Value:
        self._asked += 1
        try:
            volts = await self._volts()
        except ProtocolError:
            self._holes += 1
            self._told.number(self._meter.answered_ns)
            raise
        t_ns = self._meter.answered_ns
        return _Value(self._told.number(t_ns), volts, self._meter.asked_ns, t_ns)

    async def _volts(self) -> float:
        volts = await self._meter.value()
        if not abs(volts) <= self._limit_v:  # also refuses NaN
            raise ProtocolError(self.name, self._meter.doubt(f"{volts:g} V"))
        return volts

    def _too_slow(self) -> list[Notice]:
        due = self._asked + self._grid.missed + self._told.missed
        if self._told_holes or due < TOLD_AFTER or self.lost < LOST_SHARE * due:
            return []
        self._told_holes = True
        took_ms = (self._meter.answered_ns - self._meter.asked_ns) / 1e6
        text = f"Of {due} values of the {self.name} {self.lost} did not come in time (an "
        text += f"answer takes {took_ms:.1f} ms): they are gaps in the recorded voltage; set "
        text += f"axis.{self.axis}.voltage.period_s above {self._grid.period_ns / 1e9:g}, or reduce this "
        text += "computer's load."
        return [Notice("SampleTiming", "minor", text, self.axis)]

    def _placed(self, ticks: TickClock) -> list[VoltageSamples]:
        """Return the values whose time is settled by now; those read too far from their instant are gaps."""
        counter, t_ns, error_ns, volts = [], [], [], []
        while self._waiting and (not ticks.running or ticks.covers(self._waiting[0].answered_ns + SETTLED_NS)):
            one = self._waiting.popleft()
            at_ns, late_ns, off_ns = self._when(one, ticks)
            if one.number <= self._newest if self._meter.tells_by_itself else not self._in_time(late_ns, off_ns):
                self._holes += 1
                continue
            self._newest = one.number
            counter.append(one.number)
            t_ns.append(round(at_ns - self._late_ns))
            error_ns.append(max(1, round(off_ns + self._renewed_ns / 2)))
            volts.append(self._sign * one.volts)
        self.samples += len(volts)
        if not volts:
            return []
        rate_hz = 1e9 / self._grid.period_ns
        placed = (
            freeze_integers(np.array(counter)),
            freeze_integers(np.array(t_ns)),
            freeze_integers(np.array(error_ns)),
        )
        on_grid = self._mean or self._meter.tells_by_itself
        return [VoltageSamples(self.name, self.axis, *placed, freeze_array(np.array(volts)), rate_hz, on_grid)]

    def _when(self, one: _Value, ticks: TickClock) -> tuple[float, float, float]:
        """Return the host time (ns) of a value, its delay, and its uncertainty, without the meter's filter."""
        if self._meter.tells_by_itself:
            return one.answered_ns, 0.0, SYNC_LATENESS_NS
        return self._grid.read_at(one.number, one.asked_ns, one.answered_ns, ticks)

    def _in_time(self, late_ns: float, off_ns: float) -> bool:
        """Return whether a value can stand for its instant: a mean must lie there, an instant only keeps the order."""
        allowed_ns = TIMELY_NS if self._mean else IN_ORDER * self._grid.period_ns
        return off_ns <= TIMELY_NS and abs(late_ns) <= allowed_ns


def _turn(axis: str, config: MachineConfig) -> float:
    """Return the share of its period by which a sensor is polled later, so that those on one line take turns."""
    own = config.axis[axis].voltage
    where = {name: section.voltage for name, section in config.axis.items() if section.voltage.separate}
    peers = [name for name, v in where.items() if (v.device, v.host, v.port) == (own.device, own.host, own.port)]
    return peers.index(axis) / len(peers)
