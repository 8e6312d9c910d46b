"""Reads a voltage sensor on Modbus TCP that samples by itself and delivers its samples in blocks.

Register map (16 bit words, big-endian, the same for input and holding registers): 0-1 newest voltage float32, 2-3 its
sample counter uint32, 4-5 sample rate Hz float32, 6-7 volts per count of the block float32, 8-9 slide-way temperature
degC float32, 10 trigger, 11 status, 12-13 counter of the block's first sample uint32, 14 samples in the block, 16..115
the samples int16. Writing 1 to the trigger latches the newest samples that were not latched before. Everything is then
read with one request, so that no value is torn.

A sensor with another register map is a subclass of :class:`ModbusVoltage` that reads a :class:`SensorBlock`.
"""

import asyncio
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fdhil.config import MachineConfig
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.meter_voltage import BEYOND_LIMIT, SYNC_LATENESS_NS
from fdhil.drivers.modbus.counter_clock import CounterClock, CounterLine
from fdhil.drivers.modbus.modbus_unit import PLAUSIBLE_C, ModbusUnit
from fdhil.drivers.modbus.register_values import decode_float32, decode_uint32
from fdhil.errors import ProtocolError
from fdhil.records import Float, Notice, Temperature, VoltageSamples, freeze_array, freeze_integers

TRIGGER = 10
FIRST_SAMPLE = 16
BLOCK_SAMPLES = 100
ALL_REGISTERS = FIRST_SAMPLE + BLOCK_SAMPLES
STATUS_LOST = 2
STUCK_POLLS = 20
TEAR = 1 << 16  # the lower word of a count was read at another time than the upper one
_TEAR_SLACK_S = 0.2  # tolerance between count and elapsed time for recognising a torn count
_SETTLE_STEPS = 8
_SETTLE_STEP_S = 0.01
_SETTLED_NS = 50_000_000  # later SYNCs that are needed to recognise late stamps around a query


@dataclass(frozen=True, slots=True)
class SensorBlock:
    """One reading of the whole map: ``volts`` (n,) are the samples ``first`` .. ``first`` + n - 1.

    ``newest`` is the number of the newest complete sample, ``newest_v`` its value. ``celsius`` NaN: no temperature.
    """

    newest: int
    rate_hz: float
    celsius: float
    lost: bool
    first: int
    volts: Float
    newest_v: float


def parse_block(name: str, registers: Sequence[int]) -> SensorBlock:
    """Decode and validate the map; ProtocolError for an impossible value."""
    rate_hz, volts_per_count, celsius = (decode_float32(registers, at) for at in (4, 6, 8))
    count, first, newest = registers[14], decode_uint32(registers, 12), decode_uint32(registers, 2)
    for what, ok in (
        (f"a sample rate of {rate_hz} Hz", math.isfinite(rate_hz) and 0.1 <= rate_hz <= 1e6),
        (f"{volts_per_count} volts per count", math.isfinite(volts_per_count) and volts_per_count != 0),
        (f"{count} samples in a block of {BLOCK_SAMPLES}", count <= BLOCK_SAMPLES),
        (f"a block that ends after the newest sample ({first} + {count} > {newest} + 1)", first + count <= newest + 1),
    ):
        if not ok:
            raise ProtocolError(name, f"the sensor reports {what}; compare its register map with the configuration")
    samples = np.array(registers[FIRST_SAMPLE : FIRST_SAMPLE + count], np.uint16).view(np.int16)
    volts = freeze_array(samples * volts_per_count)
    return SensorBlock(newest, rate_hz, celsius, registers[11] == STATUS_LOST, first, volts, decode_float32(registers))


class ModbusVoltage:
    """The voltage source ``modbus`` of one axis; ``poll_samples`` reads once and returns new samples.

    A subclass implements ``latch_samples`` and ``read_block`` for its register map, and ``example_registers``, the
    input registers from 0 on of a unit that answers, which the contract test serves.
    """

    example_registers: ClassVar[Sequence[int]] = ()

    def __init__(self, axis: str, config: MachineConfig) -> None:
        settings = config.axis[axis].voltage
        self.axis = axis
        self.name = f"voltage sensor {axis}"
        self._sign = config.axis[axis].drive.sign
        self.limit_v = BEYOND_LIMIT * config.axis[axis].regulators.voltage_limit_v
        self._period_s = config.machine.sync_period_s
        self.link = ModbusUnit(self.name, settings)
        self._host_clock: CounterClock | None = None
        self._tick_clock: CounterClock | None = None
        self._rate_hz = 0.0
        self._waiting: deque[tuple[int, int, int]] = deque(maxlen=BLOCK_SAMPLES)
        self._next: int | None = None
        self._still = 0
        self._counted: tuple[int, int] | None = None
        self._tears = 0
        self.lost = 0
        self.samples = 0

    async def poll_samples(self, ticks: TickClock) -> list[VoltageSamples | Temperature | Notice]:
        """Latch and read once; errors of the link pass through."""
        await self.latch_samples()
        block = await self.read_block()
        asked_ns, answered_ns = self.link.asked_ns, self.link.answered_ns
        for _ in range(_SETTLE_STEPS):  # the SYNCs around the query must have been drained
            if not ticks.is_running or ticks.is_covered(answered_ns):
                break
            await asyncio.sleep(_SETTLE_STEP_S)
        return self.accept_block(block, asked_ns, answered_ns, ticks)

    async def latch_samples(self) -> None:
        """Trigger the sensor to store its newest samples in the registers, where it needs that."""
        await self.link.write_register(TRIGGER, 1)

    async def read_block(self) -> SensorBlock:
        """Read the registers with one request, without changing anything; repeated samples are used once."""
        return parse_block(self.name, await self.link.read_input_registers(0, ALL_REGISTERS))

    async def format_reading(self) -> str:
        """Read without latching and format the value."""
        block = await self.read_block()
        return f"{block.newest_v:.2f} V at {block.rate_hz:g} Hz"

    def accept_block(
        self, block: SensorBlock, asked_ns: int, answered_ns: int, ticks: TickClock
    ) -> list[VoltageSamples | Temperature | Notice]:
        """Place a block on the timelines. Pure but for this object's own state."""
        out: list[VoltageSamples | Temperature | Notice] = []
        if self._is_torn(block, asked_ns):
            text = f"The {self.name} gave a torn count (its words are from different times): this answer is discarded."
            return [Notice("RegisterTear", "minor", text, self.axis)]
        self._update_clocks(block, asked_ns, answered_ns, ticks)
        block = self._drop_known_samples(block)
        out += self._check_continuity(block)
        if PLAUSIBLE_C[0] < block.celsius < PLAUSIBLE_C[1]:
            out.append(Temperature(self.axis, ticks.newest_tick, block.celsius, "slideway"))
        if block.volts.size:
            out.append(self._build_samples(block, ticks))
        return out

    def _is_torn(self, block: SensorBlock, asked_ns: int) -> bool:
        """Return whether the count is off by 2^16 from the elapsed time; twice in a row it is accepted."""
        if self._counted is None:
            leap = 0.0
        else:
            newest, then_ns = self._counted
            leap = block.newest - newest - (asked_ns - then_ns) * 1e-9 * block.rate_hz
        torn = abs(abs(leap) - TEAR) < _TEAR_SLACK_S * block.rate_hz < TEAR and self._tears == 0
        self._tears = self._tears + 1 if torn else 0
        if not torn:
            self._counted = block.newest, asked_ns
        return torn

    def _update_clocks(self, block: SensorBlock, asked_ns: int, answered_ns: int, ticks: TickClock) -> None:
        if self._host_clock is None or self._tick_clock is None or block.rate_hz != self._rate_hz:
            self._rate_hz = block.rate_hz
            self._host_clock = CounterClock(1e9 / block.rate_hz)
            self._tick_clock = CounterClock(1 / block.rate_hz / self._period_s)
            self._waiting.clear()
        self._host_clock.add_query(block.newest, asked_ns, answered_ns)
        self._waiting.append((block.newest, asked_ns, answered_ns))
        while self._waiting and (
            ticks.is_covered(self._waiting[0][2] + _SETTLED_NS) or self._tick_clock.estimate_line() is None
        ):
            newest, asked, answered = self._waiting.popleft()
            between = ticks.bound_ticks(asked, answered)
            if between is not None:
                self._tick_clock.add_query(newest, *between)

    @property
    def counter_line(self) -> CounterLine | None:
        """The sensor's samples on the SYNC count, None before that is known."""
        return self._tick_clock.estimate_line() if self._tick_clock else None

    def _drop_known_samples(self, block: SensorBlock) -> SensorBlock:
        if self._next is None or block.newest + 1 < self._next:
            return block
        known = min(max(0, self._next - block.first), block.volts.size)
        return replace(block, first=block.first + known, volts=block.volts[known:]) if known else block

    def _check_continuity(self, block: SensorBlock) -> list[Notice]:
        notices = []
        if self._next is not None and block.volts.size and block.first > self._next:
            missing = block.first - self._next
            self.lost += missing
            text = f"The {self.name} lost {missing} samples: moves in them are not identified; poll it more often."
            notices.append(Notice("SampleTiming", "minor", text, self.axis))
        self._still = 0 if block.volts.size else self._still + 1
        if self._still == STUCK_POLLS:
            text = f"The {self.name} answers but no longer samples; check whether it is in an error state."
            notices.append(Notice("StuckValue", "MAJOR", text, self.axis))
        if block.volts.size:
            self._next = block.first + block.volts.size
            self.samples += block.volts.size
        return notices

    def _build_samples(self, block: SensorBlock, ticks: TickClock) -> VoltageSamples:
        counter = block.first + np.arange(block.volts.size)
        t_ns, error_ns = self._compute_times(counter, ticks)
        return VoltageSamples(
            sensor=self.name,
            axis=self.axis,
            counter=freeze_integers(counter),
            t_ns=freeze_integers(np.round(t_ns)),
            t_error_ns=freeze_integers(np.full(counter.size, max(1, round(error_ns)))),
            voltage_v=freeze_array(self._sign * block.volts),
            sample_rate_hz=block.rate_hz,
        )

    def _compute_times(self, counter: np.ndarray, ticks: TickClock) -> tuple[np.ndarray, float]:
        """Return the host time at which each sample begins, through the SYNC count if there is one, so that delays
        common to SYNC and sensor cancel."""
        line = self.counter_line
        if line is not None and ticks.is_running:
            fraction = line.start + line.step * (counter - line.origin)
            return ticks.convert_to_ns(fraction), line.error * ticks.period_ns + SYNC_LATENESS_NS
        host = self._host_clock.estimate_line() if self._host_clock else None
        assert host is not None  # accept() has added a query
        return host.start + host.step * (counter - host.origin), host.error
