"""Decodes the PDOs of one CiA 402 drive: frames on the SYNC grid become an axis' samples. Pure: no clock, no I/O.

A sample of tick k is made of the TPDOs received after SYNC k and before SYNC k+1. The demand r[k] is the target
(0x607A) that was latched ``setpoint_delay_cycles`` before SYNC k, since the drive delays its set-point; the offset in
force o[k] comes from the sniffed 0x60B0 in the same way. A voltage that is the mean of the period before its SYNC
belongs to sample k-1. Samples are released two ticks late, when all their frames are there; a sample with a missing
frame is left out: a gap in ``tick``, counted in ``lost``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fdhil.cia402 import PdoEntry
from fdhil.config import MachineConfig
from fdhil.drivers.can.sync_grid import TickedFrames
from fdhil.drivers.cia402.drive_profile import DriveProfile, ObjectKey
from fdhil.drivers.cia402.drive_profile_file import load_profile
from fdhil.drivers.cia402.pdo_queue import (
    DecoderCounters,
    DensePdo,
    PdoQueue,
    SetpointSamples,
    SniffedSetpoint,
    decode_entry,
    lay_on_grid,
)
from fdhil.records import AxisSamples, Bool, Float, Int, Notice, freeze_array, freeze_integers

_FOREIGN_TICKS = 8
_OUTAGE = 16  # SYNCs missed at once: the producer may have restarted, and what the drive received is unknown
_MISMATCHES = 3
_READ_BACK_TOLERANCE = 2  # increments: two roundings


@dataclass(frozen=True, slots=True)
class InputSamples:
    """Digital inputs (0x60FD) of an axis: ``tick`` (n,) and ``inputs`` (n,) int64 bit fields."""

    axis: str
    tick: Int
    inputs: Int


class VoltageObject:
    """The voltage source ``drive``: a vendor object of the profile, decoded with the other TPDOs.

    ``keys`` are the objects whose product it is, ``key`` the first of them; None: the profile has none, the DC link is
    unknown, or a separate sensor measures the voltage.
    """

    def __init__(self, axis: str, config: MachineConfig, profile: DriveProfile | None = None) -> None:
        settings = config.axis[axis]
        profile = profile or load_profile(settings.drive)
        self.v_per_count = profile.compute_voltage_scale(settings)
        self.keys = () if settings.voltage.is_separate or not self.v_per_count else profile.voltage_objects
        self.key = self.keys[0] if self.keys else None
        self.rows_back = 1 if settings.voltage.sampling == "interval_mean" else 0
        self._magnitude = profile.voltage_magnitude
        self._nominal = settings.nominal

    def compute_voltage(self, counts: Sequence[Int], current_a: Float, speed_rad_s: Float) -> Float:
        """Convert the objects' counts, each (n,), to a voltage (n,).

        A magnitude gets the sign of R i + K w by the data sheet: this can be wrong only where the voltage is small.
        """
        product = np.prod(counts, axis=0)
        if not self._magnitude:
            return np.asarray(product * self.v_per_count, np.float64)
        sense = np.sign(self._nominal.R * current_a + self._nominal.K * speed_rad_s)
        return np.asarray(product * abs(self.v_per_count) * sense, np.float64)


def _fill_setpoints(row: Int, shown: Int, n: int) -> SetpointSamples:
    """Return the demand (n,) with the values (m,) that the drive sent for the samples ``row`` (m,)."""
    value, certain = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    value[row], certain[row] = shown, True
    return SetpointSamples(value, certain, 0)


class PdoDecoder:
    """Decodes one axis; ``counters`` counts lost frames, ``required`` names the TPDOs of which every sample is made.

    ValueError when the profile maps a required object in no PDO.
    """

    def __init__(self, axis: str, config: MachineConfig, profile: DriveProfile | None = None) -> None:
        self.axis = axis
        self._settings = config.axis[axis]
        self.profile = profile or load_profile(self._settings.drive)
        self.node_id = config.get_node_id(axis)
        self.counters = DecoderCounters()
        self._voltage = VoltageObject(axis, config, self.profile)
        self._queues = {s.name: PdoQueue(s, s.cob_base + self.node_id) for s in self.profile.tpdos}
        needed = [self.profile.position, self.profile.speed, self.profile.current, self.profile.statusword]
        self._places = {key: self._find_tpdo_entry(key) for key in (*needed, *self._voltage.keys)}
        self._every_sync = {spec.name for spec in self.profile.tpdos if spec.every_sync == 1}
        self.required = list(dict.fromkeys(name for name, _ in self._places.values()))
        shown = (self.profile.position_demand, self.profile.offset, self.profile.digital_inputs)
        self._shown_places = {key: self._find_tpdo_entry(key) for key in shown if self.profile.find_tpdo(key)}
        self._mm_per_increment = self._settings.scaling.sign / self._settings.scaling.increments_per_mm
        self._delay = self._settings.drive.setpoint_delay_cycles
        self._target = self._create_setpoint(self.profile.target)
        self._offset = (
            self._create_setpoint(self.profile.offset) if self.profile.find_rpdo(self.profile.offset) else None
        )
        self._setpoints = [self._target] if self._offset is None else [self._target, self._offset]
        self._syncs = np.empty(0, np.int64)
        self._next_row: int | None = None
        self._foreign_run = 0
        self._mismatches = 0
        self._reported: set[str] = set()
        self._notices: list[Notice] = []

    def _find_tpdo_entry(self, key: ObjectKey) -> tuple[str, PdoEntry]:
        found = self.profile.find_tpdo(key)
        if found is None:
            raise ValueError(f"profile {self.profile.name} maps {key[0]:04X}:{key[1]:02X} in no TPDO")
        return found[0].name, found[1]

    def _create_setpoint(self, key: ObjectKey) -> SniffedSetpoint:
        found = self.profile.find_rpdo(key)
        if found is None:
            raise ValueError(f"profile {self.profile.name} maps {key[0]:04X}:{key[1]:02X} in no RPDO")
        spec, entry = found
        return SniffedSetpoint(PdoQueue(spec, spec.cob_base + self.node_id), entry, self._delay)

    @property
    def cob_ids(self) -> frozenset[int]:
        return frozenset(spec.cob_base + self.node_id for spec in (*self.profile.tpdos, *self.profile.rpdos))

    def decode_frames(self, ticked: TickedFrames) -> list[AxisSamples | InputSamples | Notice]:
        """Decode a block of frames with ticks; return the samples that became complete, and notices."""
        for queue in (*self._queues.values(), *(setpoint.queue for setpoint in self._setpoints)):
            queue.add_frames(ticked, self.counters)
        self._syncs = np.concatenate([self._syncs, ticked.syncs.tick])
        first, stop = self._next_row or 0, ticked.last_tick - 1
        if stop <= first:
            return []
        self._next_row = stop
        self._report_wrong_lengths()
        offset = self._read_back_offset(first, stop)
        demand = self._read_back_demand(first, stop, offset)
        out: list[AxisSamples | InputSamples | Notice] = []
        out += self._decode_samples(first, stop, demand, offset)
        tick, inputs = self._decode_slow_object(self.profile.digital_inputs, first, stop)
        if tick.size:
            out.append(InputSamples(self.axis, freeze_integers(tick), freeze_integers(inputs)))
        self._drop_frames(stop)
        notices, self._notices = self._notices, []
        return [*out, *notices]

    def _drop_frames(self, row: int) -> None:
        for queue in self._queues.values():
            queue.drop_before(row)
        for setpoint in self._setpoints:
            setpoint.drop_before(row)
        self._syncs = self._syncs[np.searchsorted(self._syncs, row) :]

    def _mark_received_syncs(self, first: int, stop: int) -> Bool:
        mine = self._syncs[self._syncs.searchsorted(first) : self._syncs.searchsorted(stop)]
        received = np.zeros(stop - first, np.bool_)
        received[mine - first] = True
        return received

    def _decode_samples(
        self, first: int, stop: int, demand: SetpointSamples | None, offset: SetpointSamples | None
    ) -> list[AxisSamples]:
        received = self._mark_received_syncs(first, stop)
        grids = {name: lay_on_grid(self._queues[name], first, stop + 1) for name in self.required}
        between = self._count_sync_distances(first, stop + 1)
        lost = self._count_lost_frames(grids, between, first)
        if demand is None:
            return []
        lost += demand.lost + int(np.count_nonzero(~received))
        certain = demand.certain & received
        for key, (name, _) in self._places.items():
            back = self._voltage.rows_back if key in self._voltage.keys else 0
            certain &= grids[name].find_certain_ticks(between)[back : back + stop - first]
        if offset is not None:
            certain &= offset.certain
        self.counters.lost += demand.lost
        return [self._build_record(np.flatnonzero(certain), first, grids, demand, offset, lost)]

    def _count_sync_distances(self, first: int, stop: int) -> Int:
        """Return the periods from each SYNC of ticks [first, stop) to the next received one; 0 for a missing SYNC."""
        low, high = self._syncs.searchsorted((first, stop))
        steps = np.diff(self._syncs[low : high + 1])
        between = np.zeros(stop - first, np.int64)
        between[self._syncs[low : low + steps.size] - first] = steps
        return between

    def _count_lost_frames(self, grids: Mapping[str, DensePdo], between: Int, first: int) -> int:
        """Count irregular frames of the samples' own ticks; return the number lost.

        A SYNC that was lost on the way here did reach the drive: one frame is due for each SYNC that was sent.
        """
        due = np.where(between > _OUTAGE, 1, between)
        balances = {name: grid.balance_frames(due) for name, grid in grids.items()}
        lost = sum(self._queues[name].count_lost(gone, due[:-1], first) for name, (gone, _, _) in balances.items())
        self._report_irregular_pdos()
        self._report_late_pdos({name: int(late.sum()) for name, (_, late, _) in balances.items()})
        ambiguous = np.zeros(between.size - 1, np.bool_)
        for name, grid in grids.items():
            self.counters.duplicates += int(balances[name][2][~grid.ambiguous[:-1]].sum())
            ambiguous |= grid.ambiguous[:-1]
        self.counters.ambiguous += int(np.count_nonzero(ambiguous))
        self.counters.lost += lost
        self._detect_foreign_producer(ambiguous)
        return lost

    def _report_irregular_pdos(self) -> None:
        rare = [queue for queue in self._queues.values() if not queue.synchronous]
        if rare:
            names = ", ".join(f"{queue.spec.name} ({queue.cob_id:03X})" for queue in rare)
            kinds = ", ".join(f"0x{0x1800 + queue.spec.number - 1:04X}:02" for queue in rare)
            text = (
                f"Drive {self.axis} sends {names} with few of the SYNCs, so its samples have gaps; "
                f"set the transmission type ({kinds}) to 1, or check that it is still Operational."
            )
            self._report_once("PdoIrregular", "MAJOR", text)

    def _report_late_pdos(self, counts: Mapping[str, int]) -> None:
        names = ", ".join(f"{name} ({self._queues[name].cob_id:03X})" for name, count in counts.items() if count)
        if names:
            self.counters.late += sum(counts.values())
            text = (
                f"Drive {self.axis} sent {names} after the next SYNC; it cannot be distinguished from that "
                "cycle's, so the "
                "samples of both are discarded. Check the bus load, and whether the drive is too slow for this period."
            )
            self._report_once("LateFrame", "minor", text)

    def _detect_foreign_producer(self, ambiguous: Bool) -> None:
        clean = np.flatnonzero(~ambiguous)
        self._foreign_run = ambiguous.size - 1 - int(clean[-1]) if clean.size else self._foreign_run + ambiguous.size
        if self._foreign_run >= _FOREIGN_TICKS:
            text = (
                f"Two nodes send as drive {self.axis} (node-ID {self.node_id}): its samples are ambiguous; "
                "give each node its own node-ID."
            )
            self._report_once("ForeignProducer", "MAJOR", text)

    def _build_record(
        self,
        rows: Int,
        first: int,
        grids: Mapping[str, DensePdo],
        demand: SetpointSamples,
        offset: SetpointSamples | None,
        lost: int,
    ) -> AxisSamples:
        profile = self.profile

        def decode_object(key: ObjectKey, back: int = 0) -> Int:
            name, entry = self._places[key]
            return decode_entry(entry, grids[name].words[rows + back])

        mm = self._mm_per_increment
        speed = freeze_array(decode_object(profile.speed) * profile.compute_speed_scale(self._settings))
        current = freeze_array(decode_object(profile.current) * profile.compute_current_scale(self._settings))
        voltage: Float | None = None
        if self._voltage.keys:
            counts = [decode_object(key, self._voltage.rows_back) for key in self._voltage.keys]
            voltage = freeze_array(self._voltage.compute_voltage(counts, current, speed))
        return AxisSamples(
            axis=self.axis,
            tick=freeze_integers(rows + first),
            demand_mm=freeze_array(demand.value[rows] * mm),
            position_mm=freeze_array(decode_object(profile.position) * mm),
            speed_rad_s=speed,
            current_a=current,
            voltage_v=voltage,
            offset_mm=freeze_array(offset.value[rows] * mm if offset is not None else np.zeros(rows.size)),
            statusword=freeze_integers(decode_object(profile.statusword)),
            lost=lost,
        )

    def _decode_slow_object(self, key: ObjectKey, first: int, stop: int) -> tuple[Int, Int]:
        if key not in self._shown_places:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        name, entry = self._shown_places[key]
        tick, words = self._queues[name].select_ticks(first, stop)
        return tick, decode_entry(entry, words)

    def _read_back_offset(self, first: int, stop: int) -> SetpointSamples | None:
        """Return the offset in force on [first, stop): sniffed, else read back from the drive; None: unknown or not
        supported.

        0x60B0 at SYNC k is what was latched there, so it is in force at k + delay.
        """
        if self._offset is None:
            return None
        tick, shown = self._decode_slow_object(self.profile.offset, first, stop)
        if shown.size and self._offset.queue.tick.size == 0:
            self._offset.held = int(shown[-1])
            if self._shown_places[self.profile.offset][0] in self._every_sync:
                return _fill_setpoints(tick - first, shown, stop - first)
        return self._offset.compute_samples(first, stop)

    def _read_back_demand(self, first: int, stop: int, offset: SetpointSamples | None) -> SetpointSamples | None:
        """Return the demand on [first, stop): sniffed and compared with the drive's own, else the drive's own.

        0x6062 at SYNC k is r[k] + o[k]. A drive that plans its own path (profile position) may send it with every SYNC.
        """
        tick, shown = self._decode_slow_object(self.profile.position_demand, first, stop)
        base = shown - (offset.value[tick - first] if offset is not None else 0)
        if self._target.queue.tick.size == 0 and shown.size:
            self._target.held = int(base[-1])
            if self._shown_places[self.profile.position_demand][0] in self._every_sync:
                return _fill_setpoints(tick - first, base, stop - first)
        demand = self._target.compute_samples(first, stop)
        if demand is not None and self._target.queue.tick.size and shown.size:
            sure = demand.certain[tick - first]
            self._compare_demand((base - demand.value[tick - first])[sure])
        return demand

    def _compare_demand(self, difference: Int) -> None:
        for wrong in np.abs(difference) > _READ_BACK_TOLERANCE:
            self._mismatches = self._mismatches + 1 if wrong else 0
            if self._mismatches == _MISMATCHES:
                text = (
                    f"Drive {self.axis} follows another demand than the sniffed one, by {int(difference[-1])} "
                    "increments: its samples are not reliable; check setpoint_delay_cycles, and that only one "
                    "master sends set-points."
                )
                self._notices.append(Notice("DemandMismatch", "MAJOR", text, self.axis))

    def _report_wrong_lengths(self) -> None:
        if self.counters.short >= 3:
            text = (
                f"Drive {self.axis} sends PDOs shorter than its mapping: they are discarded; check the drive's mapping."
            )
            self._report_once("PdoLength", "MAJOR", text)
        if self.counters.long:
            text = f"Drive {self.axis} sends PDOs longer than its mapping: the rest is ignored; commission it again."
            self._report_once("PdoMapping", "minor", text)

    def _report_once(self, code: str, severity: Literal["minor", "MAJOR"], text: str) -> None:
        if code not in self._reported:
            self._reported.add(code)
            self._notices.append(Notice(code, severity, text, self.axis))
