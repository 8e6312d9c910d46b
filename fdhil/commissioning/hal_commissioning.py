"""Commission an axis of HAL pins with LinuxCNC idle: offsets arrive, HAL limits them, and they end without fdhil.

The bridge accepts offsets as the guard sends them, one per SYNC. The offset that HAL applies is read back in the same
cycle. On any failure sending stops, and HAL ramps the offset to zero by itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from fdhil.cia402 import COB_SYNC, pack_pdo, unpack_pdo
from fdhil.commissioning.commissioning_record import CommissioningRecord, compute_axis_digest
from fdhil.commissioning.transmit import SocketcandSender
from fdhil.config import MachineConfig, OffsetBounds
from fdhil.drivers import FrameRing, load_profile
from fdhil.errors import DriveFault

STEPS_UM = (10.0, 50.0)  # the second if friction holds the axis against the first
SETTLE_CYCLES, AVERAGE_CYCLES = 400, 100
LISTEN_CYCLES = 200
TRIES = 8  # on a busy computer the streamer occasionally runs empty, which removes the offset
SILENCE_S = 2.0
ZERO_WITHIN_CYCLES = 1000
ENABLED_MASK, ENABLED = 0x6F, 0x27
FINGERPRINT = "hal"


@dataclass(slots=True)
class HalSamples:
    """What HAL reported per cycle, in increments: applied offset, demand with it, position; the last statusword."""

    applied: list[int] = field(default_factory=list)
    demand: list[int] = field(default_factory=list)
    position: list[int] = field(default_factory=list)
    status: int = 0

    def average_newest(self, what: list[int]) -> float:
        """Return the mean of the newest cycles."""
        return float(np.mean(what[-AVERAGE_CYCLES:]))


class HalAxis:
    """Connects to the bridge for one axis; a context manager. ConnectError without the bridge."""

    def __init__(self, config: MachineConfig, axis: str) -> None:
        settings = config.axis[axis]
        self.device = f"axis {axis}"
        if settings.correction is None:
            text = f"there is no [axis.{axis}.correction]: offsets are not allowed, so there is nothing to prove"
            raise DriveFault(self.device, f"{text}; add that section and write the HAL file again with fdhil init")
        self.per_mm = settings.scaling.increments_per_mm
        self.bounds = OffsetBounds.derive(settings, config.machine.sync_period_s)
        profile, self._node_id = load_profile(settings.drive), config.get_node_id(axis)
        self._tpdos = {spec.cob_base + self._node_id: spec for spec in profile.tpdos}
        offset = profile.find_rpdo(profile.offset)
        assert offset is not None
        self._offset = offset[0]
        self._port = SocketcandSender(settings.drive.bus, config.bus[settings.drive.bus])
        self._ring = FrameRing()

    def __enter__(self) -> HalAxis:
        return self

    def __exit__(self, *_: object) -> None:
        self._port.close()

    def exchange_cycles(self, cycles: int, increments: int | None) -> HalSamples:
        """Answer so many SYNCs with an offset (None: with nothing); return what HAL reported. DriveFault on silence."""
        seen, last_frame_s = HalSamples(), time.monotonic()
        while len(seen.applied) < cycles:
            self._port.receive_frames(self._ring, 0.05)
            for frame in self._ring.drain_frames():
                can_id = int(frame["id"])
                data = int(frame["data"]).to_bytes(8, "little")[: int(frame["dlc"])]
                if can_id == COB_SYNC:
                    last_frame_s = time.monotonic()
                    if increments is not None:
                        values = (increments, data[0])
                        self._port.send(self._offset.cob_base + self._node_id, pack_pdo(self._offset.entries, values))
                elif can_id in self._tpdos:
                    self._decode_tpdo(can_id, data, seen)
            if time.monotonic() - last_frame_s > SILENCE_S:
                text = f"the bridge has sent nothing for {SILENCE_S:g} s: HAL ramps the offset to zero by itself"
                raise DriveFault(self.device, f"{text}; start LinuxCNC and repeat the command")
        return seen

    def _decode_tpdo(self, can_id: int, data: bytes, seen: HalSamples) -> None:
        entries = self._tpdos[can_id].entries
        value = dict(zip([entry.index for entry in entries], unpack_pdo(entries, data), strict=True))
        seen.status = value.get(0x6041, seen.status)
        seen.position += [value[0x6064]] if 0x6064 in value else []
        if 0x60B0 in value:
            seen.applied.append(value[0x60B0])
            seen.demand.append(value[0x6062])


def commission_hal(
    config: MachineConfig, axis: str, report: Callable[[str], None] = lambda _step: None
) -> CommissioningRecord:
    """Commission one axis and return its record (not saved yet); ``report`` gets the name of each step before it.

    DriveFault for every deviation, ConnectError without the bridge.
    """
    with HalAxis(config, axis) as hal:
        report("listen")
        _require_standstill(hal)
        report("move")
        moved_um, most = _prove_offset_step(hal)
        report("watchdog test")
        _prove_offset_timeout(hal, most)
    return CommissioningRecord(
        axis=axis,
        vendor_id=0,
        product_code=0,
        revision=0,
        serial=0,
        config_digest=compute_axis_digest(config, axis),
        mapping_fingerprint=FINGERPRINT,
        options={},
        following_error_window_um=config.axis[axis].drive.following_error_window_mm * 1e3,
        offset_in_feedforward=True,  # pid and drive see the command with it
        sign_test_um=round(moved_um, 2),
        readback_ok=True,
        watchdog="proven",
        created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _require_standstill(hal: HalAxis) -> None:
    seen = hal.exchange_cycles(LISTEN_CYCLES, None)
    if seen.status & ENABLED_MASK != ENABLED:
        raise DriveFault(hal.device, "is not enabled; switch the machine on in LinuxCNC and home it, then start again")
    if max(seen.demand) != min(seen.demand):
        raise DriveFault(hal.device, "is moving; stop the program, then start again")
    if any(seen.applied):
        raise DriveFault(hal.device, "already has an offset; disarm first, and end any other client of the bridge")


def _prove_offset_step(hal: HalAxis) -> tuple[float, int]:
    """Step the offset: HAL must apply it within its limits, demand and position follow. Return um and increments."""
    before = hal.exchange_cycles(SETTLE_CYCLES, 0)
    _, rate, acceleration, *_ = hal.bounds.whole_increments
    steps = [um for um in STEPS_UM if um * 1e-3 * hal.per_mm <= hal.bounds.offset]
    for um in steps:
        step = round(um * 1e-3 * hal.per_mm)
        after = _hold_offset(hal, step)
        applied = after.average_newest(after.applied)
        if abs(applied - step) > 1.5:
            text = f"an offset of {um:g} um was sent, but HAL applies {applied / hal.per_mm * 1e3:.1f}"
            raise DriveFault(
                hal.device, f"{text} um; load fdhil's HAL file, and compare [axis.X.correction] with limit3"
            )
        speeds = np.diff(after.applied)
        if np.abs(speeds).max() > 1.2 * rate + 2 or np.abs(np.diff(speeds)).max() > 1.2 * acceleration + 4:
            text = "HAL applies a step faster than limit3 of this configuration allows"
            raise DriveFault(hal.device, f"{text}; write the HAL file again with fdhil init, and restart LinuxCNC")
        if abs(after.average_newest(after.demand) - before.average_newest(before.demand) - step) > 1.5:
            raise DriveFault(hal.device, "the offset does not reach the command; check the nets of fdhil's HAL file")
        moved = (after.average_newest(after.position) - before.average_newest(before.position)) / step
        if 0.5 <= moved <= 1.5:
            return moved * um, step
    text = f"an offset of {um:g} um moved the measured position by {moved * um:.1f} um"
    raise DriveFault(hal.device, f"{text}; check position_feedback, its sign and scale, and the stiffness of the loop")


def _hold_offset(hal: HalAxis, step: int) -> HalSamples:
    for _ in range(TRIES):
        seen = hal.exchange_cycles(2 * SETTLE_CYCLES, step)
        if set(seen.applied[-2 * AVERAGE_CYCLES :]) <= {step - 1, step, step + 1}:
            break
    return seen


def _prove_offset_timeout(hal: HalAxis, held: int) -> None:
    _hold_offset(hal, held)
    seen = hal.exchange_cycles(ZERO_WITHIN_CYCLES, None)
    if any(seen.applied[-AVERAGE_CYCLES:]):
        text = "HAL keeps the offset although none is sent: its watchdog does not work"
        raise DriveFault(
            hal.device, f"{text}; restart LinuxCNC and check fdhil-gate and fdhil-watchdog in the HAL file"
        )
