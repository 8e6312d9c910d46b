"""Reads the machine's records until it is cancelled; a failed source is opened again with increasing delay."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol

from fdhil.cancellation import run_attempt
from fdhil.config import MachineConfig
from fdhil.daemon.bus_health import BusHealth
from fdhil.errors import DeviceError
from fdhil.pipeline import Record
from fdhil.records import NcState, Notice

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 5.0

Take = Callable[[Record | NcState | Notice], None]


class RecordSource(Protocol):
    """The daemon's view of a machine: its records in blocks, and counts of received and lost frames."""

    async def run(self, take: Take) -> None:
        """Pass records to ``take`` until the source ends; DeviceError when a device fails permanently."""

    def get_counters(self) -> Mapping[str, Any]:
        """Return counts of frames received, lost and the like."""

    def dump_recent_frames(self) -> Mapping[str, str]:
        """Return the frames of the last seconds of each bus, as the lines of a log."""


OpenSource = Callable[[MachineConfig], AbstractAsyncContextManager[RecordSource]]


class Acquisition:
    """A machine's source across reconnections; ``source`` is None while none is open."""

    def __init__(
        self,
        config: MachineConfig,
        open_source: OpenSource,
        hearing: BusHealth,
        tell: Callable[[Sequence[Notice]], None],
    ) -> None:
        self.source: RecordSource | None = None
        self.opened = asyncio.Event()
        self._config, self._open_source = config, open_source
        self._hearing, self._tell = hearing, tell
        self._delay_s = FIRST_RETRY_S

    async def run(self, take: Take, end_s: float) -> None:
        """Pass records to ``take`` until cancelled; closing the source then has ``end_s``.

        A source that cannot be opened at the start ends the daemon with the reason: it is a fault of the setup.
        """
        while True:
            try:
                await run_attempt("machine", self._run_source(take), end_s)
                cause = "the source ended"
            except (DeviceError, OSError) as error:
                if not self.opened.is_set():
                    raise
                cause = str(error)
            self.source = None
            self._hearing.note_source_lost(asyncio.get_running_loop().time())
            text = f"{cause}; it is opened again in {self._delay_s:.1f} s; identified parameters are kept."
            self._tell([Notice("SourceLost", "MAJOR", text)])
            await asyncio.sleep(self._delay_s)
            self._delay_s = min(LAST_RETRY_S, 2 * self._delay_s)

    async def _run_source(self, take: Take) -> None:
        async with self._open_source(self._config) as source:
            self.source = source
            self._hearing.note_source_opened(asyncio.get_running_loop().time())
            if self.opened.is_set():
                self._tell([Notice("SourceLost", "info", "The machine's source is open again.")])
            self.opened.set()
            await source.run(take)

    def reset_retry_delay(self) -> None:
        """Reset the retry delay: records arrive."""
        self._delay_s = FIRST_RETRY_S
