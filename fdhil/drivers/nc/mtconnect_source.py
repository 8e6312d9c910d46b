"""Receives an NC's state from its MTConnect agent: the current state, then every change, as a stream over HTTP.

The agent sends changes every ``period_s``, and an empty document when there are none: a document is no older than the
one before it. The agent's stamps separate the changes within a document; its clock is not compared with ours.
"""

import asyncio
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AsyncExitStack
from typing import Self
from urllib.parse import quote

from fdhil.config import MachineConfig
from fdhil.drivers.nc.http_stream import MultipartSplitter, Response, open_document
from fdhil.drivers.nc.mtconnect_xml import Observation, Streams, find_data_item, read_streams, select_components
from fdhil.drivers.nc.nc_profile import NcProfile, Shown, StateTranslator
from fdhil.drivers.nc.nc_profile_file import read_nc_profile
from fdhil.drivers.nc.value_timing import bound_value_time
from fdhil.errors import DeviceTimeout, ProtocolError
from fdhil.records import NcState

ANSWER_S = 5.0
MOST_OBSERVATIONS = 10_000  # of one document
TOGETHER_S = 0.01


class MtConnectSource:
    """The NC source ``mtconnect``."""

    def __init__(self, config: MachineConfig) -> None:
        self._settings = config.nc_source.mtconnect
        self._silence_s = config.nc_source.silence_s
        self._url = self._settings.url.rstrip("/")
        self.name = f"MTConnect agent at {self._url.removeprefix('http://')}"
        self._profile: NcProfile = read_nc_profile(self._settings.profile, "mtconnect")
        self._translator = StateTranslator(self._profile, self.name)
        self._open = AsyncExitStack()
        self._waiting: list[NcState] = []
        self._signals: dict[str, str] = {}  # by dataItemId
        self._shown: dict[str, Shown] = {}
        self._instance = ""
        self._came_ns = self._way_ns = self._stamp_ns = 0

    async def __aenter__(self) -> Self:
        self._translator.reset_blocks()
        self._shown, self._waiting = {}, []
        try:
            streams, asked_ns, came_ns = await self._read_current()
            self._select_signals(streams)
            stamp_ns, error_ns = bound_value_time(asked_ns, came_ns, self._settings.renewed_s)
            self._waiting.append(self._build_state(stamp_ns, error_ns))
            self._came_ns, self._way_ns = came_ns, came_ns - asked_ns
            self._response = await self._open_stream(streams)
            self._parts = MultipartSplitter(self.name, self._response.headers.get("content-type", ""))
        except BaseException:
            await self._open.aclose()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._open.aclose()

    async def _read_current(self) -> tuple[Streams, int, int]:
        asked_ns = time.monotonic_ns()
        try:
            async with (
                asyncio.timeout(ANSWER_S),
                open_document(self.name, f"{self._device_url}/current", ANSWER_S) as response,
            ):
                document = await response.read_document()
        except TimeoutError:
            text = f"does not answer within {ANSWER_S:g} s; is the agent overloaded?"
            raise DeviceTimeout(self.name, text) from None
        return read_streams(document, self.name), asked_ns, time.monotonic_ns()

    @property
    def _device_url(self) -> str:
        device = self._settings.device
        return f"{self._url}/{quote(device, safe='')}" if device else self._url

    async def _open_stream(self, streams: Streams) -> Response:
        count = min(MOST_OBSERVATIONS, streams.buffer_size or MOST_OBSERVATIONS)
        heartbeat_ms = max(1, round(min(2 * self._settings.period_s, self._silence_s / 4) * 1e3))
        query = f"from={streams.next_sequence}&interval={round(self._settings.period_s * 1e3)}&count={count}"
        url = f"{self._device_url}/sample?{query}&heartbeat={heartbeat_ms}"
        response = await self._open.enter_async_context(open_document(self.name, url, ANSWER_S))
        if response.status != 200 or "xml" in response.headers.get("content-type", ""):
            async with asyncio.timeout(ANSWER_S):
                read_streams(await response.read_document(), self.name)  # its error names the cause
            raise ProtocolError(self.name, f"refuses a stream (HTTP {response.status}); compare url")
        return response

    def _select_signals(self, streams: Streams) -> None:
        components = select_components(streams.components, self._settings.device, self._settings.path, self.name)
        found = {name: find_data_item(components, signal.at) for name, signal in self._profile.signals.items()}
        lacking = [
            signal.at for name, signal in self._profile.signals.items() if found[name] is None and not signal.optional
        ]
        if lacking:
            text = f"does not report {', '.join(lacking)}; compare the profile with its /current"
            raise ProtocolError(self.name, f"{text}, and see docs/how-to/g0-over-the-network.md")
        self._signals = {item: name for name, item in found.items() if item is not None}
        self._instance = streams.instance
        for each in (each for component in components for each in component.observed):
            self._store_observation(each)

    def _store_observation(self, observed: Observation) -> bool:
        name = self._signals.get(observed.item)
        if name is not None:
            self._shown[name] = observed.text
        return name is not None

    def _build_state(self, stamp_ns: int, error_ns: int) -> NcState:
        self._stamp_ns = max(self._stamp_ns, stamp_ns)
        return self._translator.translate_state(self._shown, self._stamp_ns, error_ns)

    async def read_states(self) -> Sequence[NcState]:
        """Return the states of the next document; DeviceError."""
        while not self._waiting:
            came = await self._response.read_some()
            if not came:
                raise ProtocolError(
                    self.name, "it ended the stream; was the agent restarted, or is a proxy in between?"
                )
            for document in self._parts.split_parts(came):
                self._waiting += self._build_states(read_streams(document, self.name))
        states, self._waiting = self._waiting, []
        return states

    def _build_states(self, streams: Streams) -> Iterator[NcState]:
        if streams.instance != self._instance:
            raise ProtocolError(self.name, "the agent was restarted; it is read from the beginning")
        came_ns = time.monotonic_ns()
        since_ns, self._came_ns = (
            self._came_ns - self._way_ns,
            came_ns,
        )  # what is new is no older than the last document
        own = sorted(
            (each for component in streams.components for each in component.observed if each.item in self._signals),
            key=lambda each: each.sequence,
        )
        stamp_ns, error_ns = bound_value_time(
            since_ns if own else came_ns - self._way_ns, came_ns, self._settings.renewed_s
        )
        last_s = own[-1].time_s if own else None
        for time_s, observed in _group_by_time(own):
            for each in observed:
                self._store_observation(each)
            before_s = max(0.0, last_s - time_s) if last_s is not None and time_s is not None else 0.0
            yield self._build_state(stamp_ns - min(round(before_s * 1e9), came_ns - since_ns), error_ns)
        if not own:
            yield self._build_state(stamp_ns, error_ns)


def _is_simultaneous(one_s: float | None, other_s: float | None) -> bool:
    return one_s is not None and other_s is not None and abs(other_s - one_s) <= TOGETHER_S


def _group_by_time(observed: Iterable[Observation]) -> Iterator[tuple[float | None, list[Observation]]]:
    """Yield the observations of one instant together, in order: an agent stamps line and block one after the other."""
    together: list[Observation] = []
    for each in observed:
        if together and not _is_simultaneous(together[0].time_s, each.time_s):
            yield together[0].time_s, together
            together = []
        together.append(each)
    if together:
        yield together[0].time_s, together
