"""Streams samples of the axes to viewers: one JSON object per line over the control socket.

A viewer costs one encoded line per block of samples, shared by all viewers, and can never delay the daemon: each viewer
has a bounded queue, and lines that do not fit are skipped and counted.

The lines: ``begin`` has the period, the axes and the order of the signals; ``samples`` has the first ``tick`` of a
block, ``ticks`` after it where some are missing, and ``values``, float32 (7, n), NaN where a drive has no voltage;
``voltage`` is that of a separate sensor, by the host's clock, to which ``times`` maps the ticks; ``temperature`` is one
reading; ``skipped`` counts the lines that this viewer lost; ``alive`` is sent when there is nothing else.
"""

import asyncio
import base64
import contextlib
from collections import deque
from typing import Any

import numpy as np

from fdhil.arming import Answer, make_refusal
from fdhil.config import MachineConfig
from fdhil.json_lines import encode_line
from fdhil.records import AxisSamples, Temperature, TickTimes, VoltageSamples

LIVE_SIGNALS = ("voltage_v", "current_a", "speed_rad_s", "following_error_um", "offset_um", "position_mm", "demand_mm")
MAX_VIEWERS = 4
MAX_WAITING = 400  # lines per viewer: five seconds of four axes
ALIVE_S = 1.0
DEAD_S = 60.0  # a viewer that reads nothing for so long has gone
BUFFER = 64 * 1024  # bytes per viewer in the socket's own buffer


class _Viewer:
    def __init__(self) -> None:
        self._lines: deque[bytes] = deque()
        self._skipped = 0
        self.waiting = asyncio.Event()

    def queue_line(self, line: bytes) -> None:
        """Queue a line, or skip and count it."""
        if len(self._lines) >= MAX_WAITING:
            self._skipped += 1
        else:
            self._lines.append(line)
            self.waiting.set()

    def take_lines(self) -> bytes:
        """Return all queued lines and the count of skipped ones; a keep-alive when there are none."""
        lines = list(self._lines)
        if self._skipped:
            lines.append(encode_line({"live": "skipped", "lines": self._skipped}))
        self._lines.clear()
        self._skipped = 0
        self.waiting.clear()
        return b"".join(lines) or encode_line({"live": "alive"})


class LiveStream:
    """Distributes the machine's records to viewers."""

    def __init__(self, config: MachineConfig) -> None:
        self._begin = {
            "sync_period_s": config.machine.sync_period_s,
            "axes": list(config.axis),
            "signals": LIVE_SIGNALS,
        }
        self._by_the_clock = any(axis.voltage.is_separate for axis in config.axis.values())
        self._temperatures: dict[str, bytes] = {}
        self._viewers: set[_Viewer] = set()

    def open_stream(self) -> Answer:
        """Return the answer that opens a stream, or a refusal."""
        if len(self._viewers) >= MAX_VIEWERS:
            return make_refusal(
                "Busy", f"{MAX_VIEWERS} other viewers are connected", "close one of them; `fdhil web` needs only one"
            )
        return {"ok": True, "live": "begin", **self._begin}

    def publish_record(self, record: object) -> None:
        """Pass a record to all viewers; records that cannot be drawn against time are ignored."""
        if isinstance(record, Temperature):
            self._temperatures[record.axis] = encode_line(
                {"live": "temperature", "axis": record.axis, "place": record.place, "celsius": record.celsius}
            )
        line = self._encode_record(record) if self._viewers else None
        if line is not None:
            for viewer in self._viewers:
                viewer.queue_line(line)

    def _encode_record(self, record: object) -> bytes | None:
        """Encode a record; None for an empty block (no complete sample) and other records."""
        if isinstance(record, Temperature):
            return self._temperatures[record.axis]
        if isinstance(record, AxisSamples) and record.tick.size:
            return encode_line(_build_samples_document(record))
        if isinstance(record, VoltageSamples) and record.t_ns.size:
            values = {"t_ns": encode_base64(record.t_ns, "<i8"), "values": encode_base64(record.voltage_v, "<f4")}
            return encode_line({"live": "voltage", "axis": record.axis, **values})
        if isinstance(record, TickTimes) and record.tick.size and self._by_the_clock:
            ends = {"tick": record.tick[[0, -1]].tolist(), "t_ns": record.t_ns[[0, -1]].tolist()}
            return encode_line({"live": "times", **ends})
        return None

    async def serve_viewer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Stream to one viewer until it disconnects; TimeoutError when it reads nothing for a minute."""
        if len(self._viewers) >= MAX_VIEWERS:
            return  # others connected at the same time
        writer.transport.set_write_buffer_limits(BUFFER)
        viewer = _Viewer()
        for line in self._temperatures.values():
            viewer.queue_line(line)
        self._viewers.add(viewer)
        try:
            while not reader.at_eof():
                writer.write(viewer.take_lines())
                async with asyncio.timeout(DEAD_S):
                    await writer.drain()
                if not viewer.waiting.is_set():
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(ALIVE_S):
                            await viewer.waiting.wait()
        finally:
            self._viewers.discard(viewer)


def _build_samples_document(block: AxisSamples) -> dict[str, Any]:
    voltage = np.full(block.tick.size, np.nan) if block.voltage_v is None else block.voltage_v
    error_um = (block.demand_mm - block.position_mm) * 1e3
    motor = [voltage, block.current_a, block.speed_rad_s]
    values = np.stack([*motor, error_um, block.offset_mm * 1e3, block.position_mm, block.demand_mm])
    after = block.tick - block.tick[0]
    whole = int(after[-1]) == block.tick.size - 1
    return {
        "live": "samples",
        "axis": block.axis,
        "tick": int(block.tick[0]),
        "lost": block.lost,
        **({} if whole else {"ticks": encode_base64(after, "<i4")}),
        "values": encode_base64(values, "<f4"),
    }


def encode_base64(values: np.ndarray[Any, Any], kind: str) -> str:
    """Encode numbers as base64 of their bytes in the type ``kind``."""
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()


def decode_base64(text: str, kind: str) -> np.ndarray[Any, Any]:
    """Decode numbers (n,) from base64 of their bytes in the type ``kind``; ValueError when it is invalid."""
    return np.frombuffer(base64.b64decode(text, validate=True), kind)
