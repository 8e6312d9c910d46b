"""Keeps the recent samples of one axis on the SYNC grid, and extracts recordings from them.

Pure: no clock is read. A lost sample stays NaN, and a separate sensor's voltage is placed by the offset between its own
count and the SYNC count, never by single arrival times. Rows are copied once, from the received blocks to the
recording; its windows are views of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from fdhil.config import Axis
from fdhil.identification import find_runs
from fdhil.pipeline.table_sample_buffer import MotorMotion, TableSampleBuffer
from fdhil.records import (
    AxisSamples,
    Float,
    Int,
    Recording,
    SlowVoltage,
    TableSamples,
    TickTimes,
    VoltageSamples,
    freeze_array,
    make_read_only_view,
)

PLACING_BLOCKS = 40  # some 2 s of a sensor that is polled every 50 ms
CLOCK_TOLERANCE = 500e-6  # two quartz clocks
LEAST_FOR_RATE = 100  # samples from which the sensor's own rate is used
MOST_LATE = 0.499  # of a period: the samples keep their order
RATE_TOLERANCE = 0.01  # tolerance of a sensor's rate to a multiple of the SYNC rate

Block = TypeVar("Block")


class SampleBuffer:
    """The newest ``capacity`` ticks of one axis' samples, of its voltage sensor and of the SYNC's arrival times.

    ``section`` is the axis' own of the machine's config.
    """

    def __init__(self, axis: str, section: Axis, capacity: int, period_s: float) -> None:
        self._axis = axis
        self._section = section
        self._capacity = capacity
        self._period_s = period_s
        self._period_ns = period_s * 1e9
        self.separate_voltage = section.voltage.is_separate
        self._first_tick: int | None = None
        self._samples: deque[AxisSamples] = deque()
        self._voltage: deque[VoltageSamples] = deque()
        self._times: deque[TickTimes] = deque()
        self._table = TableSampleBuffer(capacity)

    @property
    def newest_tick(self) -> int | None:
        """The newest tick that was sampled, None before the first."""
        return int(self._samples[-1].tick[-1]) if self._samples else None

    def clear(self) -> None:
        """Discard everything: the SYNC count was restarted."""
        self._first_tick = None
        self._samples.clear()
        self._voltage.clear()
        self._times.clear()
        self._table.clear()

    def append_block(self, block: AxisSamples | VoltageSamples | TableSamples | TickTimes) -> None:
        """Append a block and drop what is older than the capacity; an empty block is ignored."""
        if isinstance(block, TableSamples):
            self._table.append_block(block)
            return
        if isinstance(block, AxisSamples):
            if block.tick.size:
                self._first_tick = int(block.tick[0]) if self._first_tick is None else self._first_tick
                _append_block(self._samples, block, lambda b: b.tick, self._capacity)
        elif block.t_ns.size and isinstance(block, VoltageSamples):
            _append_block(self._voltage, block, lambda b: b.t_ns, self._capacity * self._period_ns)
        elif block.t_ns.size and isinstance(block, TickTimes):
            _append_block(self._times, block, lambda b: b.t_ns, self._capacity * self._period_ns)

    def has_voltage_until(self, tick: int) -> bool:
        """Whether the separate sensor has delivered past ``tick``; False until its place on the grid is known."""
        if self._is_slow():
            line = self._fit_sample_times()
            return line is not None and line[0] + line[1] * (int(self._voltage[-1].counter[-1]) + 1) >= tick
        place = self._align_to_grid()
        return place is not None and int(self._voltage[-1].counter[-1]) >= place.convert_to_counter(tick + 1)

    def extract_recording(self, start: int, stop: int) -> Recording:
        """Return the ticks ``start`` .. ``stop`` - 1, or those since the first; samples never received are NaN.

        Row k of the voltage is the mean over the period that begins at tick k (or the instant, as the source samples);
        its delay is the residual of the alignment to whole ticks.
        """
        first = start if self._first_tick is None else self._first_tick
        start = max(start, first)
        n = max(0, stop - start)
        blocks = [b for b in self._samples if b.tick[-1] >= start and b.tick[0] < stop]
        speed = _place_on_grid(((b.tick, b.speed_rad_s) for b in blocks), start, n)
        voltage, delay, slow = None, None, None
        if self.separate_voltage and self._is_slow():
            slow = self._extract_slow_voltage(start, n)
        elif self.separate_voltage:
            voltage, delay = self._extract_separate_voltage(start, n)
        elif blocks and all(b.voltage_v is not None for b in blocks):
            voltage = _place_on_grid(((b.tick, b.voltage_v) for b in blocks if b.voltage_v is not None), start, n)
        position = _place_on_grid(((b.tick, b.position_mm) for b in blocks), start, n)
        mm_per_tick = self._section.screw_pitch_mm / (2 * math.pi) * self._period_s
        motion = MotorMotion(start, position, speed * mm_per_tick)
        return Recording(
            axis=self._axis,
            dt_s=self._period_s,
            time_s=freeze_array(np.arange(start - first, start - first + n) * self._period_s),
            voltage_v=voltage,
            current_a=_place_on_grid(((b.tick, b.current_a) for b in blocks), start, n),
            speed_rad_s=speed,
            position_mm=position,
            demand_mm=_place_on_grid(((b.tick, b.demand_mm) for b in blocks), start, n),
            voltage_sampling=self._section.voltage.sampling,
            pitch_mm=self._section.screw_pitch_mm,
            rapid_speed_rad_s=self._section.rapid_speed_rad_s,
            gaps=tuple((int(a), int(b)) for a, b in find_runs(~np.isfinite(speed))),
            slow_voltage=slow,
            start_tick=start,
            voltage_delay_s=delay,
            offset_mm=_place_on_grid(((b.tick, b.offset_mm) for b in blocks), start, n),
            table_mm=self._table.place_positions(motion),
            table_m_s2=self._table.resample_accelerations(motion),
        )

    def _is_slow(self) -> bool:
        """Whether the separate sensor samples more slowly than the SYNC, beyond what two clocks differ by."""
        return bool(self._voltage) and self._compute_samples_per_tick() < 1 - RATE_TOLERANCE

    def _compute_samples_per_tick(self) -> float:
        return self._period_ns * 1e-9 * self._voltage[-1].sample_rate_hz

    def _locate_sample_starts(self, spare_ns: float = 0.0) -> tuple[Int, Float] | None:
        """Return count and begin (ticks) of the newest samples, interpolated in the SYNC's arrivals; None without any.

        Only the newest blocks are used: two clocks that drift apart differ by less than 0.1 sample in that time.
        """
        if not self._voltage or not self._times:
            return None
        recent = list(self._voltage)[-PLACING_BLOCKS:]
        tick_ns = np.concatenate([b.t_ns for b in self._times])
        tick = np.concatenate([b.tick for b in self._times])
        counter = np.concatenate([b.counter for b in recent])
        begins_ns = np.concatenate([b.t_ns for b in recent])
        inside = (begins_ns >= tick_ns[0]) & (begins_ns <= tick_ns[-1] + spare_ns)
        return (counter[inside], np.interp(begins_ns[inside], tick_ns, tick)) if inside.any() else None

    def _fit_sample_times(self) -> tuple[float, float] | None:
        """Return begin (ticks) of sample 0 and ticks per sample, by the newest blocks and the SYNC's arrivals."""
        located = self._locate_sample_starts()
        if located is None:
            return None
        counter, begins = located
        nominal = 1 / self._compute_samples_per_tick()
        spread = counter - counter.mean()
        power = float(spread @ spread)
        slope = float(spread @ begins) / power if counter.size >= LEAST_FOR_RATE else nominal
        slope = float(np.clip(slope, nominal * (1 - CLOCK_TOLERANCE), nominal * (1 + CLOCK_TOLERANCE)))
        return float(np.median(begins - slope * counter)), slope

    def _extract_slow_voltage(self, start: int, n: int) -> SlowVoltage | None:
        """Return the sensor's samples that lie entirely between the ticks, on its own grid; None without any."""
        line = self._fit_sample_times()
        if line is None:
            return None
        first = int(np.ceil((start - line[0]) / line[1] - 1e-9))
        count = int(np.floor((start + n - 1 - line[0]) / line[1] + 1e-9)) - first
        if count < 1:
            return None
        values = _place_on_grid(((b.counter, b.voltage_v) for b in self._voltage), first, count)
        late = None if self._voltage[-1].on_grid else self._compute_sample_delays(line, first, count)
        error = float(np.median(np.concatenate([b.t_error_ns for b in self._voltage]))) * 1e-9
        period_s = self._period_ns * 1e-9
        return SlowVoltage((line[0] + first * line[1] - start) * period_s, line[1] * period_s, error, values, late)

    def _compute_sample_delays(self, line: tuple[float, float], first: int, count: int) -> Float:
        """Return by how much later (s) than on the line each value (count,) was true, 0 where there is none."""
        tick_ns = np.concatenate([b.t_ns for b in self._times])
        tick = np.concatenate([b.tick for b in self._times])
        begins = ((b.counter, np.interp(b.t_ns, tick_ns, tick)) for b in self._voltage)
        late = np.nan_to_num(_place_on_grid(begins, first, count) - (line[0] + line[1] * (first + np.arange(count))))
        return freeze_array(np.clip(late, -MOST_LATE * line[1], MOST_LATE * line[1]) * self._period_ns * 1e-9)

    def _extract_separate_voltage(self, start: int, n: int) -> tuple[Float | None, float | None]:
        place = self._align_to_grid()
        if place is None:
            return None, None
        samples = ((b.counter, b.voltage_v) for b in self._voltage)
        values = _place_on_grid(samples, place.convert_to_counter(start), n * place.ratio)
        return values.reshape(-1, place.ratio).mean(axis=1), place.delay_s

    def _align_to_grid(self) -> _GridAlignment | None:
        """Return the sensor's alignment to the grid; None while it is unknown or its rate is no multiple of SYNC's.

        It is the median of the samples' lead over their ticks.
        """
        samples = self._compute_samples_per_tick() if self._voltage else 0.0
        ratio = round(samples)
        if ratio < 1 or abs(samples / ratio - 1) > RATE_TOLERANCE:
            return None
        located = self._locate_sample_starts(self._period_ns)
        if located is None:
            return None
        counter, begins = located
        ahead = float(np.median(counter - ratio * begins))
        offset = round(ahead)
        return _GridAlignment(ratio, offset, (ahead - offset) / ratio * self._period_ns * 1e-9)


@dataclass(frozen=True, slots=True)
class _GridAlignment:
    """Sensor sample ``offset`` + ``ratio`` * k begins with tick k, except that the voltage is late by ``delay_s``."""

    ratio: int
    offset: int
    delay_s: float

    def convert_to_counter(self, tick: int) -> int:
        return self.offset + self.ratio * tick


def _append_block(queue: deque[Block], block: Block, at: Callable[[Block], Int], reach: float) -> None:
    queue.append(block)
    while at(block)[-1] - at(queue[0])[-1] > reach:
        queue.popleft()


def _place_on_grid(parts: Iterable[tuple[Int, Float]], first: int, n: int) -> Float:
    """Return the values (n,) of ``parts``, each with its counts, from the count ``first`` on; NaN without a value."""
    values = np.full(n, np.nan)
    for counts, part in parts:
        row = counts - first
        inside = (row >= 0) & (row < n)
        values[row[inside]] = part[inside]
    return make_read_only_view(values)
