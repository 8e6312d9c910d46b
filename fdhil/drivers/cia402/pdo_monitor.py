"""Detects TPDOs that never arrive though SYNC runs; they are reported by name and do not count as lost. Pure."""

from collections.abc import Collection

import numpy as np

from fdhil.cia402 import Nmt
from fdhil.drivers.can.sync_grid import TickedFrames
from fdhil.drivers.cia402.drive_profile import PdoSpec
from fdhil.records import Notice

PATIENCE_S = 10.0  # of SYNC: an NC may run it for a while before it starts its drives


class PdoMonitor:
    """Monitors the TPDOs of one drive; ``needed`` names those without which it has no samples."""

    def __init__(
        self, axis: str, node_id: int, tpdos: Collection[PdoSpec], needed: Collection[str], period_s: float
    ) -> None:
        self._axis, self._node_id, self._needed = axis, node_id, needed
        self._missing = {spec.cob_base + node_id: spec.name for spec in tpdos if spec.valid}
        self._patience = round(PATIENCE_S / period_s)
        self._reported = False

    def watch_frames(self, ticked: TickedFrames, nmt: Nmt | None) -> list[Notice]:
        """Take a block of frames and the drive's NMT state, None while it is unknown."""
        if not self._missing:
            return []
        for can_id in np.intersect1d(ticked.can_id, list(self._missing)).tolist():
            del self._missing[can_id]
        if self._reported and not self._missing:
            return [Notice("PdoMissing", "info", f"Drive {self._axis} sends all its TPDOs now.", self._axis)]
        if self._reported or not self._missing or ticked.last_tick < self._patience:
            return []
        self._reported = True
        names = ", ".join(f"{name} ({can_id:03X})" for can_id, name in self._missing.items())
        if nmt in (None, Nmt.OPERATIONAL):
            advice = "compare its mapping, COB-IDs and transmission types with fdhil check"
        else:
            advice = f"its NMT state is {nmt.name.lower().replace('_', '-')}: let the NC start it"
        text = f"Drive {self._axis} (node-ID {self._node_id}) never sent {names} though SYNC runs; {advice}."
        serious = any(name in self._needed for name in self._missing.values())
        return [Notice("PdoMissing", "MAJOR" if serious else "minor", text, self._axis)]
