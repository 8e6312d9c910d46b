"""Decodes the TPDO of an encoder at the table: of a second axis, or of an encoder node. Pure."""

import numpy as np

from fdhil.cia402 import PdoEntry
from fdhil.config import IN_A_FRAME, TableEncoder
from fdhil.drivers.can.sync_grid import TickedFrames
from fdhil.drivers.cia402.pdo_queue import decode_entry
from fdhil.records import Notice, TableSamples, freeze_array

SILENT_TICKS = 3000  # of SYNC without that TPDO until it is reported


class TpdoEncoder:
    """The table encoder of one axis; ``short`` counts frames that are too short."""

    def __init__(self, axis: str, settings: TableEncoder) -> None:
        assert settings.cob_id is not None  # checked by the configuration
        self.axis = axis
        self.short = 0
        self._settings = settings
        self.cob_id = settings.cob_id
        bits = IN_A_FRAME[settings.type]
        self._entry = PdoEntry(0, 0, bits, settings.type.startswith("int"), 8 * settings.byte)
        self._newest = -1
        self._received_at: int | None = None
        self._silent = False

    def decode_frames(self, ticked: TickedFrames) -> list[TableSamples | Notice]:
        """Return the samples of a block, and notices. Two frames after one SYNC are ambiguous, and neither is used."""
        out: list[TableSamples | Notice] = []
        mine = (ticked.can_id == self.cob_id).nonzero()[0]
        long_enough = ticked.length[mine].astype(np.int64) * 8 >= self._entry.bit_offset + self._entry.bits
        self.short += int(np.count_nonzero(~long_enough))
        mine = mine[long_enough & (ticked.tick[mine] >= 0)]
        tick, first, count = np.unique(ticked.tick[mine], return_index=True, return_counts=True)
        sure = (count == 1) & (tick > self._newest)
        if tick.size:
            self._newest = self._received_at = int(tick[-1])
        if sure.any():
            counts = decode_entry(self._entry, ticked.data[mine[first[sure]]])
            values = freeze_array(counts * self._settings.scale + self._settings.offset)
            out.append(TableSamples(self.axis, "table_mm", freeze_array(tick[sure]), 0.0, values))
        return out + self._check_silence(ticked.last_tick)

    def _check_silence(self, last_tick: int) -> list[Notice]:
        if self._received_at is None:
            self._received_at = last_tick
        was, self._silent = self._silent, last_tick - self._received_at > SILENT_TICKS
        if self._silent and not was:
            text = (
                f"No TPDO {self.cob_id:#x} with the position of table {self.axis} is received: its compliance "
                "cannot be identified; "
                "check that its node is started, that the TPDO is synchronous, and cob_id."
            )
            return [Notice("TableSilent", "minor", text, self.axis)]
        return (
            [Notice("TableSilent", "info", "The table encoder sends again.", self.axis)]
            if was and not self._silent
            else []
        )
