"""Receives and decodes one bus, and reconnects it."""

import asyncio
from collections import Counter
from collections.abc import Mapping

from fdhil.config import MachineConfig
from fdhil.drivers.can.bus_listener import BusOpener, FrameReader, ListeningBus
from fdhil.drivers.can.frame_history import FrameHistory
from fdhil.drivers.can.receive_port import Stamps
from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.cia402.bus_decoder import BusDecoder
from fdhil.drivers.cia402.pdo_decoder import InputSamples
from fdhil.drivers.moves import load_event_source
from fdhil.drivers.sensor_source import BACK_OFF_S, Record, Take
from fdhil.errors import ConnectError
from fdhil.records import AxisSamples, MoveEvent, NcState, Notice, TickTimes

DRAIN_S = 0.05
SILENCE_S = 2.0
STAMPS_COST: Mapping[Stamps, str] = {
    "adapter": "the adapter's own clock, with an unknown delay of about 1 ms over USB",
    "host": "this program when it reads them, some 10 ms late and in bursts, more on a busy computer",
}


class BusSource:
    """One bus: drains the ring, decodes the frames, and reconnects after a failure."""

    def __init__(self, name: str, config: MachineConfig, open_bus: BusOpener = ListeningBus) -> None:
        self.name = name
        self._config, self._open_bus = config, open_bus
        self._bus: FrameReader | None = None
        self.decoder = BusDecoder(name, config)
        self.ticks = TickClock(config.machine.sync_period_s)
        event_source = load_event_source(config.g0.source)
        self._events = [event_source(axis, config) for axis in self.decoder.axes]
        self.history = FrameHistory()
        self._silent = False
        self._before: Counter[str] = Counter()
        self._overflow_reported = 0
        self._stamping_reported = False

    def open(self) -> None:
        """Open the bus; ConnectError when it cannot be reached."""
        settings = self._config.bus[self.name]
        filters = self.decoder.build_filters() if settings.frames == "drives" else ()
        self._bus = self._open_bus(self.name, settings, filters=filters)

    def process_frames(self, now_ns: int) -> list[Record]:
        bus = self._bus
        if bus is None:
            return []
        frames = bus.drain_frames()
        self.history.add_frames(frames)
        out: list[Record] = []
        for record in self.decoder.decode_frames(frames, now_ns):
            if isinstance(record, TickTimes):
                self.ticks.add_arrivals(record)
            if isinstance(record, AxisSamples | InputSamples | TickTimes):
                for source in self._events:
                    out += source.detect_moves(record)
            if not isinstance(record, InputSamples):
                out.append(record)
        return [*out, *self._check_time_stamps(bus), *self._check_overflow(bus), *self._check_silence(bus, now_ns)]

    def receive_nc_state(self, state: NcState) -> list[MoveEvent]:
        """Take a state of the NC; return the moves that can be classified by now."""
        return [event for source in self._events for event in source.detect_moves(state)]

    def _check_time_stamps(self, bus: FrameReader) -> list[Notice]:
        cost = STAMPS_COST.get(bus.stamps)
        if cost is None or self._stamping_reported or not bus.read_counters()["frames"]:
            return []
        self._stamping_reported = True
        text = (
            f"Frames of bus {self.name} are stamped by {cost}. Samples follow SYNC and are not affected; "
            "values of a separate"
        )
        return [
            Notice(
                "CoarseStamps", "info", f"{text} voltage sensor are placed less accurately, so that L is less certain."
            )
        ]

    def _check_overflow(self, bus: FrameReader) -> list[Notice]:
        lost = bus.read_counters()["lost"]
        if lost <= self._overflow_reported:
            return []
        new, self._overflow_reported = lost - self._overflow_reported, lost
        text = (
            f"{new} frames of bus {self.name} were not read in time and are lost; the computer is "
            "overloaded: reduce its load."
        )
        return [Notice("RxOverflow", "minor", text)]

    def _check_silence(self, bus: FrameReader, now_ns: int) -> list[Notice]:
        silent = now_ns - bus.last_frame_ns > SILENCE_S * 1e9
        was, self._silent = self._silent, silent
        if silent and not was:
            text = (
                f"No frame is received on bus {self.name}: this is normal while the NC is off and no drive "
                "sends a heartbeat "
                "(0x1017); otherwise check the drives' supply, the wiring and the bit rate. fdhil scan queries "
                "the drives."
            )
            return [Notice("BusSilent", "MAJOR", text)]
        return [Notice("BusSilent", "info", f"Bus {self.name} is active again.")] if was and not silent else []

    async def run(self, take: Take) -> None:
        """Run for ever; reconnect with growing pauses."""
        pause = BACK_OFF_S[0]
        while True:
            await asyncio.sleep(DRAIN_S)
            for record in self.process_frames(round(asyncio.get_running_loop().time() * 1e9)):
                take(record)
            if self._bus is None or self._bus.end_reason is None:
                pause = BACK_OFF_S[0]
                continue
            reason = self._bus.end_reason
            take(
                Notice(
                    "BusDown",
                    "MAJOR",
                    f"Bus {self.name}: {reason}; nothing is received until it is reconnected, which is retried.",
                )
            )
            pause = await self._reconnect_bus(pause)
            take(Notice("BusDown", "info", f"Bus {self.name} is back."))

    async def _reconnect_bus(self, pause: float) -> float:
        self.close()
        while self._bus is None:
            await asyncio.sleep(pause)
            pause = min(2 * pause, BACK_OFF_S[1])
            try:
                await asyncio.to_thread(self.open)
            except ConnectError:
                continue
        self.decoder = BusDecoder(self.name, self._config)
        self._overflow_reported = 0
        return pause

    def read_counters(self) -> dict[str, int]:
        """Return the frames received and lost on this bus."""
        own = (
            self._bus.read_counters() if self._bus else {"frames": 0, "ring_overflow": 0, "kernel_drops": 0, "lost": 0}
        )
        decoded = self.decoder.read_counters()
        own = {key: count + self._before[key] for key, count in own.items()}
        own["lost"] += decoded["pdo_lost"] + decoded["sync_missed"]
        return own | decoded

    def close(self) -> None:
        """Close the bus; its counters are kept."""
        if self._bus is not None:
            self._before.update(self._bus.read_counters())
            self._bus.close()
            self._bus = None
