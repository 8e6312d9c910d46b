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
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.free_running_index import FreeRunningIndex
from fdhil.drivers.polling_schedule import PollingSchedule
from fdhil.drivers.sensor_connection import SensorConnection
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
    is_free_running: bool

    @property
    def link(self) -> SensorConnection:
        """Its connection."""

    async def read_value(self) -> float:
        """Return its newest value, scaled; DeviceError."""

    def describe_implausible(self, shown: str) -> str:
        """Describe an implausible value: where it was read, and what to compare."""


@dataclass(frozen=True, slots=True)
class _MeterValue:
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
        self._schedule = PollingSchedule(settings.period_s, config.machine.sync_period_s, _compute_phase(axis, config))
        self._index = FreeRunningIndex(settings.period_s)
        self._late_ns = (settings.delay_s + settings.renewed_s / 2) * 1e9
        self._mean = settings.sampling == "interval_mean"
        if self._mean:
            self._late_ns += self._schedule.period_ns  # a sample is placed at the beginning of its interval
        self._renewed_ns = settings.renewed_s * 1e9
        self._together = math.ceil(GATHER_S / settings.period_s) + 1
        self._waiting: deque[_MeterValue] = deque(maxlen=MOST_WAITING)
        self._asked = self._gaps = 0
        self._newest = -1
        self._gaps_reported = False
        self.samples = 0

    @property
    def link(self) -> SensorConnection:
        return self._meter.link

    @property
    def lost(self) -> int:
        return self._gaps + self._schedule.missed + self._index.missed

    async def poll_samples(self, ticks: TickClock) -> list[VoltageSamples | Notice]:
        """Read some values, one after the other, and return those whose time is settled; DeviceError when none came."""
        came = False
        for left in range(self._together - 1, -1, -1):
            try:
                self._waiting.append(
                    await (self._await_value() if self._meter.is_free_running else self._poll_value(ticks))
                )
                came = True
            except DeviceError as error:
                ended = isinstance(error, ConnectError | DeviceTimeout)
                if (ended or not left) and not came:
                    raise
                if ended:
                    break
        return [*self._report_slow_sensor(), *self._place_values(ticks)]

    async def format_reading(self) -> str:
        return f"{await self._read_voltage():.2f} V at {1e9 / self._schedule.period_ns:g} Hz"

    async def _poll_value(self, ticks: TickClock) -> _MeterValue:
        number, due_ns = self._schedule.schedule_next(time.monotonic_ns(), ticks)
        while (left_s := (due_ns - time.monotonic_ns()) / 1e9) > 0:
            await asyncio.sleep(min(left_s, NEAR_S))
            due_ns = self._schedule.compute_host_ns(number, ticks)  # more accurate by the SYNCs that arrived meanwhile
        self._asked += 1
        try:
            volts = await self._read_voltage()
        except DeviceError:
            self._gaps += 1
            raise
        return _MeterValue(number, volts, self._meter.asked_ns, self._meter.answered_ns)

    async def _await_value(self) -> _MeterValue:
        self._asked += 1
        try:
            volts = await self._read_voltage()
        except ProtocolError:
            self._gaps += 1
            self._index.assign_number(self._meter.answered_ns)
            raise
        t_ns = self._meter.answered_ns
        return _MeterValue(self._index.assign_number(t_ns), volts, self._meter.asked_ns, t_ns)

    async def _read_voltage(self) -> float:
        volts = await self._meter.read_value()
        if not abs(volts) <= self._limit_v:  # also refuses NaN
            raise ProtocolError(self.name, self._meter.describe_implausible(f"{volts:g} V"))
        return volts

    def _report_slow_sensor(self) -> list[Notice]:
        due = self._asked + self._schedule.missed + self._index.missed
        if self._gaps_reported or due < TOLD_AFTER or self.lost < LOST_SHARE * due:
            return []
        self._gaps_reported = True
        took_ms = (self._meter.answered_ns - self._meter.asked_ns) / 1e6
        text = f"Of {due} values of the {self.name} {self.lost} did not come in time (an "
        text += f"answer takes {took_ms:.1f} ms): they are gaps in the recorded voltage; set "
        text += f"axis.{self.axis}.voltage.period_s above {self._schedule.period_ns / 1e9:g}, or reduce this "
        text += "computer's load."
        return [Notice("SampleTiming", "minor", text, self.axis)]

    def _place_values(self, ticks: TickClock) -> list[VoltageSamples]:
        """Return the values whose time is settled by now; those read too far from their instant are gaps."""
        counter, t_ns, error_ns, volts = [], [], [], []
        while self._waiting and (not ticks.is_running or ticks.is_covered(self._waiting[0].answered_ns + SETTLED_NS)):
            one = self._waiting.popleft()
            at_ns, late_ns, off_ns = self._locate_value(one, ticks)
            if one.number <= self._newest if self._meter.is_free_running else not self._is_timely(late_ns, off_ns):
                self._gaps += 1
                continue
            self._newest = one.number
            counter.append(one.number)
            t_ns.append(round(at_ns - self._late_ns))
            error_ns.append(max(1, round(off_ns + self._renewed_ns / 2)))
            volts.append(self._sign * one.volts)
        self.samples += len(volts)
        if not volts:
            return []
        rate_hz = 1e9 / self._schedule.period_ns
        placed = (
            freeze_integers(np.array(counter)),
            freeze_integers(np.array(t_ns)),
            freeze_integers(np.array(error_ns)),
        )
        on_grid = self._mean or self._meter.is_free_running
        return [VoltageSamples(self.name, self.axis, *placed, freeze_array(np.array(volts)), rate_hz, on_grid)]

    def _locate_value(self, one: _MeterValue, ticks: TickClock) -> tuple[float, float, float]:
        """Return the host time (ns) of a value, its delay, and its uncertainty, without the meter's filter."""
        if self._meter.is_free_running:
            return one.answered_ns, 0.0, SYNC_LATENESS_NS
        return self._schedule.locate_reading(one.number, one.asked_ns, one.answered_ns, ticks)

    def _is_timely(self, late_ns: float, off_ns: float) -> bool:
        """Return whether a value can stand for its instant: a mean must lie there, an instant only keeps the order."""
        allowed_ns = TIMELY_NS if self._mean else IN_ORDER * self._schedule.period_ns
        return off_ns <= TIMELY_NS and abs(late_ns) <= allowed_ns


def _compute_phase(axis: str, config: MachineConfig) -> float:
    """Return the share of its period by which a sensor is polled later, so that those on one line take turns."""
    own = config.axis[axis].voltage
    where = {name: section.voltage for name, section in config.axis.items() if section.voltage.is_separate}
    peers = [name for name, v in where.items() if (v.device, v.host, v.port) == (own.device, own.host, own.port)]
    return peers.index(axis) / len(peers)
