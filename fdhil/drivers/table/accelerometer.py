"""Reads an accelerometer at the table that streams a line of text per sample over a serial port."""

import re
import time
from collections import deque

import numpy as np

from fdhil.config import Accelerometer
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.serial.text_instrument import InstrumentLine
from fdhil.drivers.serial.text_lines import LineReader, TextLine
from fdhil.drivers.table.arrival_clock import ArrivalClock
from fdhil.errors import DeviceTimeout, ProtocolError
from fdhil.records import Notice, TableSamples, freeze_array

SILENCE_NS = 1_000_000_000
SETTLED_NS = 50_000_000  # later SYNCs that are needed to recognise late stamps around an arrival
WRAPS = (1 << 8, 1 << 16, 1 << 24, 1 << 32)  # where devices' counts wrap
LARGEST_GAP = 5000  # samples that may be lost at once; a larger step is another count
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class AccelerometerLine(InstrumentLine):
    """The serial line to a free-running device."""

    timeout_code = "TableSilent"

    def __init__(self, name: str, settings: Accelerometer) -> None:
        super().__init__(name, settings)
        self.place = settings.device
        self._reader = LineReader(self.port, name)
        self._received_ns = 0

    async def connect(self) -> None:
        await super().connect()
        self._received_ns = time.monotonic_ns()

    async def read_lines(self) -> list[TextLine]:
        """Return the received lines; DeviceTimeout after a second without any, ConnectError."""
        found = []
        while (line := await self._reader.read_line(time.monotonic_ns())) is not None:
            found.append(line)
        if found:
            self._received_ns = found[-1].t_ns
        elif time.monotonic_ns() - self._received_ns > SILENCE_NS:
            self._received_ns = time.monotonic_ns()
            raise DeviceTimeout(
                self.name, f"nothing comes from {self.place}; check that the sensor streams, and its rate"
            )
        return found


class StreamedAccelerometer:
    """The accelerometer of one axis: ``samples`` received, ``lost`` by the sensor's own count."""

    def __init__(self, axis: str, settings: Accelerometer, period_s: float) -> None:
        self.axis = axis
        self.name = f"accelerometer {axis}"
        self.link = AccelerometerLine(self.name, settings)
        self.samples = self.lost = 0
        self._settings = settings
        self._period_s = period_s
        self._arrivals = ArrivalClock(settings.rate_hz, period_s)
        self._waiting: deque[tuple[int, int]] = deque(maxlen=1000)
        self._held: list[tuple[int, float]] = []
        self._newest: int | None = None
        self._last_count: int | None = None

    async def poll_samples(self, ticks: TickClock) -> list[TableSamples | Notice]:
        """Return new samples; errors of the link pass, ProtocolError where no line is a sample."""
        return self.accept_lines(await self.link.read_lines(), ticks)

    async def format_reading(self) -> str:
        until_ns = time.monotonic_ns() + SILENCE_NS
        while not (found := await self.link.read_lines()):
            if time.monotonic_ns() > until_ns:
                raise DeviceTimeout(self.name, f"nothing comes from {self.link.place}; check that the sensor streams")
        return f"{self._parse_numbers(found[-1].text)[1]:.2f} m/s2"

    def accept_lines(self, lines: list[TextLine], ticks: TickClock) -> list[TableSamples | Notice]:
        """Place lines on the SYNC count. Pure but for this object's own state."""
        lost_before = self.lost
        for line in lines:
            try:
                sample = self._parse_numbers(line.text)
            except ProtocolError:  # the first line may be incomplete; others are damaged
                if line is lines[-1] and len(lines) > 1 and not self._held:
                    raise
                continue
            self._held.append(self._unwrap_count(*sample))
            self.samples += 1
            self._waiting.append((self._held[-1][0], line.t_ns))
        while self._waiting and ticks.is_covered(self._waiting[0][1] + SETTLED_NS):
            count, t_ns = self._waiting.popleft()
            if (between := ticks.bound_ticks(t_ns, t_ns)) is not None:
                self._arrivals.add_arrival(count, sum(between) / 2)
        out: list[TableSamples | Notice] = [*self._place_samples()]
        if self.lost > lost_before:
            text = f"The {self.name} lost {self.lost - lost_before} samples: moves in them are analysed without it."
            out.append(Notice("SampleTiming", "minor", text, self.axis))
        return out

    def _parse_numbers(self, text: str) -> tuple[int | None, float]:
        s = self._settings
        numbers = _NUMBER.findall(text)
        if len(numbers) < max(s.column, s.count_column):
            wanted = max(s.column, s.count_column)
            cause = f"the line {text[:40]!r} has {len(numbers)} numbers, but column {wanted} is configured"
            raise ProtocolError(self.name, f"{cause}; compare column and count_column with what the sensor sends")
        count = int(float(numbers[s.count_column - 1])) if s.count_column else None
        return count, float(numbers[s.column - 1]) * s.scale

    def _unwrap_count(self, count: int | None, value: float) -> tuple[int, float]:
        before = self._newest
        step = 1 if count is None or self._last_count is None else _count_step(self._last_count, count)
        if before is None or not 1 <= step <= LARGEST_GAP:
            self._held.clear()
            self._waiting.clear()
            self._arrivals = ArrivalClock(self._settings.rate_hz, self._period_s)
            self._newest = count or 0
        else:
            self.lost += step - 1
            self._newest = before + step
        self._last_count = count
        return self._newest, value

    def _place_samples(self) -> list[TableSamples]:
        line = self._arrivals.estimate_line()
        if line is None or not self._held:
            return []
        counts, values = (np.array(column) for column in zip(*self._held, strict=True))
        self._held.clear()
        late = self._settings.late_s / self._period_s
        tick = line.start + line.step * (counts - line.origin) - late
        return [
            TableSamples(
                self.axis,
                "table_m_s2",
                freeze_array(tick),
                line.error,
                freeze_array(values),
                rate_per_tick=1.0 / line.step,
            )
        ]


def _count_step(before: int, count: int) -> int:
    """Return the increase of a count, which may have wrapped at the next power that devices use."""
    wrap = next((w for w in WRAPS if w > before), WRAPS[-1])
    return count - before if count > before else count - before + wrap
