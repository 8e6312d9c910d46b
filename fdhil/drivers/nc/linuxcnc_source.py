"""Receives LinuxCNC's state through its bridge (fdhil/bridges/linuxcnc.py): JSON lines over TCP, exact to a servo
cycle.

The first line identifies the bridge, each later one is the state in one servo cycle: a change of it with the cycle
before, and a few in between. ``cycle`` is the count of the servo thread and ``mm`` its set-points.
"""

import asyncio
import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, Self

from fdhil.config import MachineConfig
from fdhil.drivers.can.host_clock import RemoteClock
from fdhil.errors import ConnectError, DeviceError, ProtocolError
from fdhil.json_lines import decode_line
from fdhil.records import MoveKind, NcState

SCHEMA = "fdhil-linuxcnc-1"
MOST_BYTES = 1 << 16
CONNECT_S = 2.0
HERE = ("127.0.0.1", "localhost", "::1")
DISTANT_WINDOW_S = 60.0
LARGEST = 1 << 60  # of what is counted: ns for 36 years
NETWORK_NS = 5_000_000  # delay of the quickest recent line


class LinuxCncSource:
    """The NC source ``linuxcnc``."""

    def __init__(self, config: MachineConfig) -> None:
        settings = config.nc_source.linuxcnc
        self._place = settings.host, settings.port
        self._axes, self._mm_per_degree = tuple(config.axis), config.mm_per_degree
        self._silence_s = config.nc_source.silence_s
        self.name = f"LinuxCNC at {settings.host}:{settings.port}"
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._period_s = 0.0
        # another computer has its own monotonic clock
        self._distant = None if settings.host in HERE else RemoteClock(DISTANT_WINDOW_S)
        self._waiting: deque[bytes] = deque()  # lines
        self._rest = b""  # incomplete last line

    async def __aenter__(self) -> Self:
        host, port = self._place
        self._waiting.clear()
        self._rest = b""
        try:
            async with asyncio.timeout(CONNECT_S):
                self._reader, self._writer = await asyncio.open_connection(host, port)
        except (OSError, TimeoutError) as error:
            cause = "no answer" if isinstance(error, TimeoutError) else error
            text = f"it cannot be reached ({cause}); load the bridge in LinuxCNC's HAL file and start LinuxCNC"
            raise ConnectError(self.name, text) from None
        try:
            async with asyncio.timeout(self._silence_s):
                self._check_greeting(await self._next_message())
        except TimeoutError:
            self._disconnect()
            raise ProtocolError(self.name, "the server there sends nothing: it is not the bridge; check port") from None
        except DeviceError:
            self._disconnect()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        self._disconnect()

    def _disconnect(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._reader = self._writer = None

    async def read_states(self) -> Sequence[NcState]:
        """Return the next states; those that have already arrived are returned together."""
        states = [self._parse_state(await self._next_message())]
        while self._waiting:
            states.append(self._parse_state(await self._next_message()))
        return states

    async def _next_message(self) -> Mapping[str, Any]:
        while not self._waiting:
            await self._receive_lines()
        line = self._waiting.popleft()
        message = decode_line(line)
        if message is None:
            raise ProtocolError(self.name, f"sent {line[:60]!r}, which is not a state; is this the bridge's port?")
        return message

    async def _receive_lines(self) -> None:
        assert self._reader is not None
        try:
            came = await self._reader.read(MOST_BYTES)
        except OSError as error:
            raise ConnectError(self.name, f"the bridge is lost ({error}); is LinuxCNC still running?") from None
        if not came:
            raise ConnectError(self.name, "the bridge has ended; start LinuxCNC again")
        *lines, self._rest = (self._rest + came).split(b"\n")
        self._waiting.extend(lines)
        if len(self._rest) > MOST_BYTES:
            raise ProtocolError(self.name, "sends no lines of text; is this the bridge's port?")

    def _check_greeting(self, message: Mapping[str, Any]) -> None:
        period_s = message.get("servo_period_s")
        if message.get("schema") != SCHEMA or not isinstance(period_s, float) or not 1e-5 < period_s < 1.0:
            raise ProtocolError(
                self.name, f"is not a bridge of this fdhil ({SCHEMA}); load the bridge that came with it"
            )
        self._period_s = period_s

    def _parse_state(self, message: Mapping[str, Any]) -> NcState:
        try:
            stamp_ns, error_ns = _parse_whole(message["stamp_ns"]), _parse_whole(message["error_ns"])
            if self._distant is not None:
                stamp_ns -= self._distant.track_ahead_ns(stamp_ns, time.monotonic_ns())
                error_ns += NETWORK_NS
            return NcState(
                stamp_ns=stamp_ns,
                error_ns=error_ns,
                motion=MoveKind(message["motion"]),
                line=_convert_optional(message, "line", _parse_whole),
                programmed_feed_mm_min=_convert_optional(message, "programmed_feed_mm_min", _parse_finite),
                feed_mm_min=_convert_optional(message, "feed_mm_min", _parse_finite),
                feed_override=_convert_optional(message, "feed_override", _parse_finite),
                rapid_override=_convert_optional(message, "rapid_override", _parse_finite),
                feed_hold=_convert_optional(message, "feed_hold", bool),
                tool=_convert_optional(message, "tool", _parse_whole),
                program=_convert_optional(message, "program", str),
                demand_mm=self._convert_demand_mm(message["mm"]),
                nc_tick=_parse_whole(message["cycle"]),
                nc_period_s=self._period_s,
            )
        except (KeyError, ValueError, TypeError, AttributeError, OverflowError) as error:
            raise ProtocolError(
                self.name, f"a state cannot be read ({error!r}); use the bridge of this fdhil"
            ) from None

    def _convert_demand_mm(self, places: Mapping[str, Any]) -> dict[str, float]:
        """Return the positions of the machine's drives: the same for both of a gantry axis, degrees as arc lengths."""
        found = {str(axis): _parse_finite(place) for axis, place in places.items()}
        found |= {name: found[name[0]] for name in self._axes if name[0] in found}
        return {name: place * self._mm_per_degree.get(name, 1.0) for name, place in found.items()}


def _convert_optional(message: Mapping[str, Any], key: str, kind: Any) -> Any:
    value = message.get(key)
    return None if value is None else kind(value)


def _parse_whole(value: Any) -> int:
    number = int(value)
    if abs(number) > LARGEST:
        raise ValueError("a number with more than 18 digits")
    return number


def _parse_finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value!r} is not a number")
    return number
