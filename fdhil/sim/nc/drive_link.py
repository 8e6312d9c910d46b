"""Tracks one drive from the NC's side and builds its frames: set-points, steps to Operation enabled, SDO writes."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field

from fdhil.sim.drive.operation_modes import CYCLIC_POSITION
from fdhil.sim.drive.pdo_engine import Pdo
from fdhil.sim.drive.power_stage import PowerState
from fdhil.sim.frame_types import BusFrame

CONTROLWORD, STATUSWORD, TARGET, POSITION, MODE = 0x604000, 0x604100, 0x607A00, 0x606400, 0x606000
_OFFSETS = frozenset({0x60B000, 0x60B100, 0x60B200})
_SILENCE_CYCLES = 5
ENABLED = 0x0F
SHUTDOWN = 0x06
_WORDS = {
    PowerState.SWITCH_ON_DISABLED: SHUTDOWN,
    PowerState.READY: 0x07,
    PowerState.SWITCHED_ON: ENABLED,
    PowerState.OPERATION_ENABLED: ENABLED,
    PowerState.QUICK_STOP_ACTIVE: 0x00,
}


def decode_power_state(statusword: int) -> PowerState:
    """Return the power state that a statusword shows (CiA 402-2, table 30)."""
    for mask in (0x6F, 0x4F):
        try:
            return PowerState(statusword & mask)
        except ValueError:
            continue
    return PowerState.NOT_READY


@dataclass(frozen=True, slots=True)
class PdoWiring:
    """The PDOs by which the NC controls a drive, and its cyclic ``mode`` with the object to write it to.

    ``missing`` are the required objects that no valid PDO carries. A drive counts as silent without a statusword for
    ``patience`` SYNCs; one that sends it by event never does.
    """

    setpoints: tuple[Pdo, ...] = ()
    answers: tuple[Pdo, ...] = ()
    missing: tuple[str, ...] = ()
    mode: int = CYCLIC_POSITION
    mode_index: int = 0x6060
    patience: float = float("inf")

    @classmethod
    def choose_pdos(cls, rpdos: Iterable[Pdo], tpdos: Iterable[Pdo], mode: int, mode_index: int) -> PdoWiring:
        """Choose among a drive's PDOs: as few as possible, without offsets where another PDO suffices."""
        received = sorted(rpdos, key=lambda pdo: (CONTROLWORD not in pdo.keys, not _OFFSETS.isdisjoint(pdo.keys)))
        received.sort(key=lambda pdo: not {CONTROLWORD, TARGET}.issubset(pdo.keys))
        sent = list(tpdos)
        chosen = {}
        for key, pdos in ((TARGET, received), (CONTROLWORD, received), (STATUSWORD, sent), (POSITION, sent)):
            chosen[key] = next((pdo for pdo in pdos if key in pdo.keys), None)
        used = {pdo.cob_id: pdo for pdo in chosen.values() if pdo is not None}
        status = chosen[STATUSWORD]
        kind = 255 if status is None else status.kind
        return cls(
            tuple(pdo for pdo in used.values() if pdo in received),
            tuple(pdo for pdo in used.values() if pdo in sent),
            tuple(f"{key >> 8:04X}" for key, pdo in chosen.items() if pdo is None),
            mode,
            mode_index,
            _SILENCE_CYCLES * max(kind, 1) if kind <= 240 else float("inf"),
        )


@dataclass(slots=True)
class DriveLink:
    """One drive as seen by the NC, with the PDOs it was wired to, and the last controlword.

    ``increments_per_mm`` has the sign of the axis; ``silent`` counts the SYNCs since the last statusword.
    """

    axis: str
    bus: str
    node_id: int
    increments_per_mm: float
    delay: int
    wiring: PdoWiring = field(default_factory=PdoWiring)
    word: int = SHUTDOWN
    status: int | None = None
    position: int | None = None
    silent: int = 0

    @property
    def state(self) -> PowerState:
        return PowerState.NOT_READY if self.status is None else decode_power_state(self.status)

    def build_setpoint_frames(self, target: int) -> list[BusFrame]:
        """Return controlword and target position; other objects in those RPDOs stay zero."""
        values = {CONTROLWORD: self.word, TARGET: target, MODE: self.wiring.mode}
        return [
            (self.bus, (pdo.cob_id, pdo.codec.pack(*[0 if key is None else values.get(key, 0) for key in pdo.keys])))
            for pdo in self.wiring.setpoints
        ]

    def receive_tpdo(self, can_id: int, data: bytes) -> None:
        """Process a TPDO; one shorter than its mapping is ignored."""
        for pdo in self.wiring.answers:
            if pdo.cob_id != can_id or len(data) < pdo.codec.size:
                continue
            for key, value in zip(pdo.keys, pdo.codec.unpack_from(data), strict=True):
                if key == STATUSWORD:
                    self.status, self.silent = value, 0
                elif key == POSITION:
                    self.position = value

    def step_toward_enabled(self) -> list[BusFrame]:
        """Return one step toward Operation enabled, with the actual position as target."""
        if self.position is None:
            return []
        if self.state is PowerState.FAULT:  # a reset is a rising edge
            self.word = 0x00 if self.word == 0x80 else 0x80
        else:
            self.word = _WORDS.get(self.state, self.word)
        return self.build_setpoint_frames(self.position)


@dataclass(slots=True)
class SdoWrite:
    """An SDO write of one byte that awaits its answer; ``required``: an abort ends the takeover."""

    link: DriveLink
    index: int
    value: int
    required: bool
    sent: bool = False
    cycles: int = 0

    @property
    def frame(self) -> BusFrame:
        """The expedited download (CiA 301, 7.2.4.3.3)."""
        write = struct.pack("<BHBB3x", 0x2F, self.index, 0, self.value & 0xFF)
        return self.link.bus, (0x600 + self.link.node_id, write)
