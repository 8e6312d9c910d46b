"""Receives the NC's states for ever: connects its source, hands its states over, and reconnects it."""

import asyncio
import time
from collections.abc import Callable

from fdhil.cancellation import run_attempt
from fdhil.config import MachineConfig
from fdhil.drivers.nc import load_nc_source
from fdhil.errors import DeviceError, DeviceTimeout
from fdhil.records import MoveKind, NcState, Notice

BACK_OFF_S = (0.1, 5.0)
CODE = "NcSilent"
EFFECT = "Rapid moves cannot be recognised meanwhile; none is used for identification. The connection is retried."


class NcListener:
    """The NC of a machine, by its source of ``tables.NC_SOURCES``; ``read_counters`` counts states and failures."""

    def __init__(self, config: MachineConfig) -> None:
        self._source = load_nc_source(config.g0.source)(config)
        self._silence_s = config.nc_source.silence_s
        self._states = self._failures = 0
        self._silent = False

    async def run(self, take: Callable[[NcState | Notice], None]) -> None:
        """Hand states over for ever; a silent NC is UNKNOWN from then on, and reported once."""
        pause_s = BACK_OFF_S[0]
        while True:
            before = self._states
            try:
                await run_attempt(self._source.name, self._receive_states(take))
            except DeviceError as error:
                self._report_loss(error, take)
            pause_s = BACK_OFF_S[0] if self._states > before else min(2 * pause_s, BACK_OFF_S[1])
            await asyncio.sleep(pause_s)

    async def _receive_states(self, take: Callable[[NcState | Notice], None]) -> None:
        async with self._source as source:
            while True:
                try:
                    async with asyncio.timeout(self._silence_s):
                        states = await source.read_states()
                except TimeoutError:
                    text = f"sent nothing for {self._silence_s:g} s; is the NC switched on and its interface running?"
                    raise DeviceTimeout(source.name, text) from None
                for state in states:
                    take(state)
                self._states += len(states)
                if states and self._silent:
                    self._silent = False
                    take(Notice(CODE, "info", f"{source.name} answers again."))

    def _report_loss(self, error: DeviceError, take: Callable[[NcState | Notice], None]) -> None:
        self._failures += 1
        take(NcState(time.monotonic_ns(), 0, MoveKind.UNKNOWN))
        if not self._silent:
            self._silent = True
            take(Notice(CODE, "MAJOR", f"{error}{'' if str(error).endswith('?') else '.'} {EFFECT}"))

    def read_counters(self) -> dict[str, int]:
        """Return the states received, and how often the NC was lost or not reached."""
        return {"states": self._states, "failures": self._failures}
