"""Reads the daemon's stream of samples once for all browsers, while at least one is watching.

The samples are kept in a ring for each axis; after a lost connection the daemon is asked again, and the gap stays. The
ticks of two buses need not agree and restart with the daemon: each axis' ticks are mapped to one count of this process
by the arrival of the first block, and stay mapped as long as they rise.
"""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.cancellation import run_attempt
from fdhil.daemon import LIVE_SIGNALS, decode_base64
from fdhil.errors import ConnectError, DeviceError
from fdhil.json_lines import decode_line
from fdhil.web.live_ring import SampleRing

KEPT_S = 300.0
SILENT_S = 5.0
RETRY_S = 1.0
LINGER_S = 60.0  # a browser that returns within it gets what it missed
SAME_COUNT_S = 1.0
LONGEST_LINE = 16 * 1024 * 1024
MAX_BROWSERS = 8
UNDRAWN_S = 5.0  # an active browser draws at least once a second
NONSENSE = (ValueError, LookupError, TypeError, ArithmeticError, RecursionError)


@dataclass(eq=False, slots=True)
class LiveViewer:
    """A watching browser: its user or address, when it last drew, and whether another one took its place."""

    owner: str
    drawn_s: float
    replaced: bool = False


class LiveFeed:
    """The newest samples of one machine. ``trouble`` says why there are none, empty while there are."""

    def __init__(self, path: Path, axes: Mapping[str, Any], period_s: float) -> None:
        self._path = path
        self.period_s = period_s
        self.rings = {axis: SampleRing(round(KEPT_S / period_s)) for axis in axes}
        self.fault_text = "waiting for the daemon"
        self.skipped_lines = 0
        self._bases: dict[str, int] = {}
        self._line: tuple[float, float] | None = None
        self.viewers: list[LiveViewer] = []
        self._wanted = asyncio.Event()

    @asynccontextmanager
    async def register_viewer(self, viewer: LiveViewer) -> AsyncIterator[None]:
        """Keep the daemon's stream open while the block is open, and a minute longer."""
        self.viewers.append(viewer)
        self._wanted.set()
        try:
            yield
        finally:
            if not viewer.replaced:
                self.viewers.remove(viewer)

    def make_room(self, owner: str) -> bool:
        """Return whether a browser of ``owner`` may watch.

        If all places are taken, a browser that draws nothing leaves for it, or one of an owner with two more.
        """
        if len(self.viewers) < MAX_BROWSERS:
            return True
        count = Counter(each.owner for each in self.viewers)
        idle = [each for each in self.viewers if time.monotonic() - each.drawn_s > UNDRAWN_S]
        greedy = [each for each in self.viewers if count[each.owner] > count[owner] + 1]
        leaving = min(idle or greedy, key=lambda each: (-count[each.owner], each.drawn_s), default=None)
        if leaving is None:
            return False
        leaving.replaced = True
        self.viewers.remove(leaving)
        return True

    async def run(self) -> None:
        """Serve until cancelled: connect while a browser watches, and again after a lost connection."""
        while True:
            await self._wanted.wait()
            try:
                await run_attempt("daemon", self._read_stream())
                self._wanted.clear()
                self.fault_text = "waiting for the daemon"
            except (OSError, TimeoutError, DeviceError, *NONSENSE) as error:
                self.fault_text = _describe_error(error)
                await asyncio.sleep(RETRY_S)
                if not self.viewers:
                    self._wanted.clear()

    async def _read_stream(self) -> None:
        reader, writer = await asyncio.open_unix_connection(str(self._path), limit=LONGEST_LINE)
        try:
            writer.write(b'{"request": "live"}\n')
            answer = await _read_line(reader)
            if answer.get("ok") is not True:
                raise ConnectError("daemon", f"{answer.get('text')}; {answer.get('advice')}")
            self._bases.clear()
            self.fault_text = ""
            seen_s = time.monotonic()
            while time.monotonic() - seen_s < LINGER_S:
                if self.viewers:
                    seen_s = time.monotonic()
                self.take_line(await _read_line(reader))
        finally:
            writer.close()

    def take_line(self, line: Mapping[str, Any]) -> None:
        """Take one line of the daemon; one of ``NONSENSE`` for an invalid one."""
        take: Callable[[Mapping[str, Any]], None] | None = {
            "samples": self._take_samples,
            "voltage": self._take_voltage,
            "times": self._take_times,
            "temperature": lambda line_of_axis: self.rings[line_of_axis["axis"]].set_temperature(
                float(line_of_axis["celsius"])
            ),
            "skipped": self._count_skipped,
        }.get(line.get("live", ""))
        if take is not None and line.get("axis", next(iter(self.rings))) in self.rings:
            take(line)

    def _take_samples(self, line: Mapping[str, Any]) -> None:
        values = decode_base64(line["values"], "<f4").reshape(len(LIVE_SIGNALS), -1)
        after = decode_base64(line["ticks"], "<i4") if "ticks" in line else np.arange(values.shape[1])
        axis, first = line["axis"], int(line["tick"])
        base = self._bases.get(axis)
        if base is None or first + base < self.rings[axis].end:
            base = self._bases[axis] = self._find_tick_base(axis, first)
        self.rings[axis].put_samples(after.astype(np.int64) + first + base, values)

    def _find_tick_base(self, axis: str, first: int) -> int:
        """Return the offset from an axis' ticks to this process' count: another axis' offset if both agree."""
        end = self.rings[axis].end
        for other, base in self._bases.items():
            apart = abs(first + base - self.rings[other].end) * self.period_s
            if other != axis and first + base >= end and apart < SAME_COUNT_S:
                return base
        return max(end, int(time.monotonic() / self.period_s)) - first

    def _take_times(self, line: Mapping[str, Any]) -> None:
        (first, last), (first_ns, last_ns) = line["tick"], line["t_ns"]
        slope = (last - first) / (last_ns - first_ns) if last_ns > first_ns else 1e-9 / self.period_s
        self._line = (first - slope * first_ns, slope)

    def _take_voltage(self, line: Mapping[str, Any]) -> None:
        base = self._bases.get(line["axis"])
        if self._line is None or base is None:
            return
        begin, slope = self._line
        ticks = np.floor(begin + slope * decode_base64(line["t_ns"], "<i8")).astype(np.int64) + base
        self.rings[line["axis"]].put_voltage(ticks, decode_base64(line["values"], "<f4"))

    def _count_skipped(self, line: Mapping[str, Any]) -> None:
        self.skipped_lines += int(line["lines"])


async def _read_line(reader: asyncio.StreamReader) -> dict[str, Any]:
    async with asyncio.timeout(SILENT_S):
        line = await reader.readline()
    if not line:
        raise ConnectError("daemon", "closed the connection; check its log")
    document = decode_line(line)
    if document is None:
        raise ConnectError("daemon", "sent an invalid line; check which process listens at its socket")
    return document


def _describe_error(error: Exception) -> str:
    if isinstance(error, DeviceError):
        return str(error)
    if isinstance(error, TimeoutError):
        return f"the daemon was silent for {SILENT_S:.0f} s; check its log"
    if isinstance(error, OSError):
        return str(ConnectError.from_socket_error("daemon", error, "is not running; start it with fdhil run CONFIG"))
    return "the daemon sent an unknown message; use the same version of fdhil for both"
