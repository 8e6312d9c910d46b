"""Decodes one bus: its SYNC grid, its drives' samples and the state of its nodes. Pure: no clock, no I/O."""

from fdhil.cia402 import COB_HEARTBEAT
from fdhil.config import MachineConfig
from fdhil.drivers.can.error_frames import ErrorFrameMonitor
from fdhil.drivers.can.filters import build_drive_filters
from fdhil.drivers.can.frame_ring import Frames
from fdhil.drivers.can.node_monitor import NodeMonitor
from fdhil.drivers.can.receive_port import Filter
from fdhil.drivers.can.sync_grid import SyncGrid
from fdhil.drivers.cia402.pdo_decoder import InputSamples, PdoDecoder
from fdhil.drivers.cia402.pdo_monitor import PdoMonitor
from fdhil.drivers.table.tpdo_encoder import TpdoEncoder
from fdhil.records import AxisSamples, Notice, TableSamples, TickTimes

_SYNC_SILENCE_NS = 1_000_000_000


class BusDecoder:
    """Decodes all drives of the bus ``[bus.NAME]``."""

    def __init__(self, bus: str, config: MachineConfig) -> None:
        realtime = config.guard.clock == "monotonic" and config.sim.pace == "realtime"
        self._errors = ErrorFrameMonitor()
        self.grid = SyncGrid(config.machine.sync_period_s, realtime)
        self.axes = [axis for axis, settings in config.axis.items() if settings.drive.bus == bus]
        self.decoders = {axis: PdoDecoder(axis, config) for axis in self.axes}
        self.watches = {axis: NodeMonitor(axis, config.get_node_id(axis)) for axis in self.axes}
        self._guard_heartbeat = COB_HEARTBEAT + config.guard.node_id
        self._pdos = {
            axis: PdoMonitor(axis, each.node_id, each.profile.tpdos, each.required, config.machine.sync_period_s)
            for axis, each in self.decoders.items()
        }
        tables = {axis: config.axis[axis].table for axis in self.axes}
        self.tables = [TpdoEncoder(axis, t) for axis, t in tables.items() if t is not None and t.source == "canopen"]
        self._last_sync_ns: int | None = None
        self._sync_lost = False

    def decode_frames(
        self, frames: Frames, now_ns: int
    ) -> list[TickTimes | AxisSamples | InputSamples | TableSamples | Notice]:
        """Decode a block of frames; return tick times, samples, inputs and notices."""
        ticked = self.grid.assign_ticks(frames)
        out: list[TickTimes | AxisSamples | InputSamples | TableSamples | Notice] = [
            *self._errors.watch_frames(frames, now_ns),
            *ticked.notices,
        ]
        if ticked.syncs.tick.size:
            out.append(ticked.syncs)
            self._last_sync_ns = int(ticked.syncs.t_ns[-1])
        out += self._check_sync_silence(now_ns)
        for axis in self.axes:
            out += self.decoders[axis].decode_frames(ticked)
            out += self.watches[axis].watch_frames(frames, now_ns)
            out += self._pdos[axis].watch_frames(ticked, self.watches[axis].nmt)
        for encoder in self.tables:
            out += encoder.decode_frames(ticked)
        return out

    def _check_sync_silence(self, now_ns: int) -> list[Notice]:
        silent = self._last_sync_ns is not None and now_ns - self._last_sync_ns > _SYNC_SILENCE_NS
        was, self._sync_lost = self._sync_lost, silent
        if silent and not was:
            text = "SYNC stopped: nothing is sampled; start the NC, or check that it still runs the bus."
            return [Notice("SyncLost", "MAJOR", text)]
        return [Notice("SyncLost", "info", "SYNC is back.")] if was and not silent else []

    def build_filters(self) -> list[Filter]:
        """Return filters for the needed frames, the guard's heartbeat included."""
        pdos = {cob_id for decoder in self.decoders.values() for cob_id in decoder.cob_ids}
        pdos |= {encoder.cob_id for encoder in self.tables}
        return build_drive_filters(
            [decoder.node_id for decoder in self.decoders.values()], pdos | {self._guard_heartbeat}
        )

    def read_counters(self) -> dict[str, int]:
        """Return counts of missed, duplicated and discarded frames, and the frames each drive sent."""
        counters = [decoder.counters for decoder in self.decoders.values()]
        return {
            "error_frames": self._errors.count,
            "sync_missed": self.grid.missed,
            "sync_duplicates": self.grid.duplicates,
            "sync_out_of_order": self.grid.out_of_order,
            "pdo_lost": sum(c.lost for c in counters),
            "pdo_short": sum(c.short for c in counters),
            "pdo_long": sum(c.long for c in counters),
            "pdo_duplicates": sum(c.duplicates for c in counters),
            "pdo_late": sum(c.late for c in counters),
            "pdo_ambiguous": sum(c.ambiguous for c in counters),
            **{f"{axis}.heard": watch.received_frames for axis, watch in self.watches.items()},
        }
