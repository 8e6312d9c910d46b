"""Runs the simulated machine, sans-I/O: drives, slide-ways, sensors and NC.

SYNC is the machine's clock. In real time and without its own NC, each drive also has its own clock.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault, StoreError
from fdhil.sim.drive import drive_description
from fdhil.sim.drive.servo_drive import SimulatedDrive
from fdhil.sim.fault_kinds import FaultEntry
from fdhil.sim.fault_script import FaultSchedule
from fdhil.sim.frame_faults import FrameFaults
from fdhil.sim.frame_types import BusFrame, Frame
from fdhil.sim.nc.drive_link import PdoWiring
from fdhil.sim.nc.nc_controller import Event, NcController
from fdhil.sim.nc.nc_path import PathRow
from fdhil.sim.simulated_axis import RpdoStream, SimulatedAxis
from fdhil.sim.slide_way import SlideWay
from fdhil.sim.table_sensors import TableSensors
from fdhil.sim.trace_recorder import TraceRecorder
from fdhil.sim.wire.modbus_sensor import VoltageSensor

SYNC = 0x80
OFFSET_OBJECTS = (0x60B0, 0x60B1, 0x60B2)


class SimulatedMachine:
    """The machine of one configuration. ``events`` collects its events; ``tick`` counts SYNC periods.

    ``wires`` are the faults of its buses, by name: the caller passes all frames through them.
    """

    def __init__(self, config: MachineConfig) -> None:
        self.config = config
        self.period_s = config.machine.sync_period_s
        self.nc = NcController(config, self._choose_wiring)
        self.events: list[Event] = []
        self.tick = 0
        self._outbox: list[BusFrame] = []
        self._injected: dict[int, tuple[str, bytes]] = {}
        self.wires = {axis.drive.bus: FrameFaults(seed=config.sim.seed) for axis in config.axis.values()}
        seeds = np.random.SeedSequence(config.sim.seed).spawn(2 * len(config.axis))
        self.units = {
            axis: self._create_axis(axis, seeds[2 * n], seeds[2 * n + 1]) for n, axis in enumerate(config.axis)
        }
        self.tables = TableSensors(config)
        self._of_bus: dict[str, list[SimulatedAxis]] = {}
        for unit in self.units.values():
            self._of_bus.setdefault(unit.bus, []).append(unit)
        self._first_bus = next(iter(self._of_bus))
        self._realtime = config.sim.pace == "realtime"
        self.faults = FaultSchedule(self.units, self.period_s)
        self._listed = [_parse_lockstep_rpdo(text, self.units) for text in config.sim.lockstep_rpdo]
        self._streams = {key: RpdoStream() for key in self._listed}
        self._rapid = False
        self._row = 0
        self._next_trace: Path | None = None
        self._recorder: TraceRecorder | None = None

    def _create_axis(
        self, axis: str, drive_seed: np.random.SeedSequence, sensor_seed: np.random.SeedSequence
    ) -> SimulatedAxis:
        section = self.config.axis[axis]
        sim = self.config.sim
        sensor = VoltageSensor(
            1 / (self.period_s * sim.modbus_cycles),
            section.regulators.voltage_limit_v,
            sim.noise.voltage_v,
            np.random.default_rng(sensor_seed),
            sim.modbus_cycles,
        )
        sensor.celsius = sim.thermal.ambient_c
        return SimulatedAxis(
            axis,
            section.drive.bus,
            SimulatedDrive(axis, self.config, np.random.default_rng(drive_seed)),
            SlideWay(sim.thermal, section.rapid_speed_rad_s, self.period_s),
            sensor,
            self._outbox,
            self._injected,
            self.wires[section.drive.bus],
        )

    def _choose_wiring(self, axis: str) -> PdoWiring:
        drive = self.units[axis].drive
        return PdoWiring.choose_pdos(
            drive.pdo.list_configured("rpdo"),
            drive.pdo.list_configured("tpdo"),
            drive.emulation.mode,
            drive.emulation.mode_index,
        )

    @property
    def buses(self) -> tuple[str, ...]:
        """The buses that have drives."""
        return tuple(self._of_bus)

    def describe_drives(self, eds: Mapping[str, Path]) -> dict[str, Any]:
        """Return the drives and bus loads (share of the bit rate) of the ready event."""
        drives = {}
        for axis, unit in self.units.items():
            drives[axis] = {**drive_description.describe_mapping(unit.drive), "eds": str(eds[axis])}
        return {
            "drives": drives,
            "bus_load": self._compute_bus_loads(stuffed=False),
            "bus_load_worst": self._compute_bus_loads(stuffed=True),
        }

    def _compute_bus_loads(self, *, stuffed: bool) -> dict[str, float]:
        rate = 1 / self.period_s
        loads = {}
        for bus, units in self._of_bus.items():
            bitrate = self.config.bus[bus].bitrate
            drives = sum(
                drive_description.compute_bus_load(unit.drive, rate, bitrate, stuffed=stuffed) for unit in units
            )
            others = [1, *self.tables.list_frame_bytes(bus)]  # SYNC and the encoders' positions
            each_sync = sum(drive_description.count_frame_bits(size, stuffed=stuffed) for size in others)
            loads[bus] = round(each_sync * rate / bitrate + drives, 4)
        return loads

    def power_on(self) -> list[BusFrame]:
        """Switch the drives on, to pre-operational; all kernels are compiled before the first SYNC."""
        for unit in self.units.values():
            unit.drive.physics.compile_kernels()
            unit.switch_power(True)
        return self._take_outbox() + self.tables.power_on()

    def receive_frame(self, bus: str, frame: Frame) -> list[Frame]:
        """Process a frame of another party and return the answers of that bus' drives."""
        can_id, data = frame
        if can_id == SYNC:
            return self._process_sync(bus, data)
        answers: list[Frame] = []
        for unit in self._of_bus.get(bus, ()):
            answers += unit.drive.receive_frame(can_id, data)
        answers += self.tables.receive_frame(bus, frame)
        if self.nc.is_on:
            self.nc.receive_frame(bus, frame)
            for answer in answers:
                self.nc.receive_frame(bus, answer)
        return answers

    def mark_frame_lost(self, bus: str, can_id: int) -> None:
        """Note a frame that a bus fault keeps from the drives: lockstep does not wait for it."""
        for unit in self._of_bus.get(bus, ()):
            unit.drive.pdo.mark_rpdo_lost(can_id)

    def run_nc_cycle(self) -> list[BusFrame]:
        """Run one period of the NC: its SYNC, the drives' answers, its set-points for the next one."""
        frames: list[BusFrame] = []
        syncs = self.nc.begin_cycle()
        self._complete_events()
        for bus, frame in syncs:
            if all(unit.sync_on for unit in self._of_bus[bus]):
                frames.append((bus, frame))
                frames += [(bus, answer) for answer in self._process_sync(bus, frame[1])]
                continue
            for unit in self._of_bus[bus]:
                unit.drive.run_unsynced_cycle()
            if bus == self._first_bus:  # a fault suppresses the SYNC; the fault must still end
                self._run_faults(None)
                self.tick += 1
        for bus, frame in self.nc.end_cycle():
            frames.append((bus, frame))
            for unit in self._of_bus[bus]:
                for answer in unit.drive.receive_frame(*frame):
                    frames.append((bus, answer))
                    self.nc.receive_frame(bus, answer)
        self._complete_events()
        return frames + self._take_outbox() if self._outbox else frames

    @property
    def is_self_clocked(self) -> bool:
        """Whether a drive moves by its own clock, so that timers must run often."""
        return any(unit.drive.is_self_clocked for unit in self.units.values())

    def run_timers(self, now_s: float) -> list[BusFrame]:
        """Run what depends on time: heartbeats and their monitoring, and motion without SYNC."""
        if not self.nc.is_on and not self.faults.is_idle:
            self._log_started_faults(self.faults.start_immediate_faults(self.tick))
        alone = self._realtime and not self.nc.is_on
        frames = self.tables.run_timers(now_s, [unit.drive for unit in self.units.values()] if alone else [])
        for unit in self.units.values():
            for frame in unit.drive.run_timers(now_s, alone=alone):
                frames.append((unit.bus, frame))
                for other in self._of_bus[unit.bus]:
                    if other is not unit and frame[0] > 0x700:
                        frames += [(unit.bus, answer) for answer in other.drive.receive_frame(*frame)]
        return frames + self._take_outbox()

    def _take_outbox(self) -> list[BusFrame]:
        frames = list(self._outbox)
        self._outbox.clear()
        return frames

    def _process_sync(self, bus: str, data: bytes) -> list[Frame]:
        row = self.nc.in_force
        playing = row is not None and row.playing
        leading = bus == self._first_bus
        if leading and not self.faults.is_idle:
            self._run_faults(self._row if playing else None)
        if leading and self._rapid != (row is not None and row.rapid):
            self._signal_rapid(not self._rapid)
        frames: list[Frame] = []
        for unit in self._of_bus[bus]:
            frames += self._advance_drive(unit, data)
        if self._injected:
            frames += self._inject_foreign_frames(bus)
        if self.nc.is_on:
            for frame in frames:
                self.nc.receive_frame(bus, frame)
        if leading:
            self.tick += 1
        if bus == self.buses[-1]:
            self._record_row(row if playing else None)
        return frames

    def _advance_drive(self, unit: SimulatedAxis, data: bytes) -> list[Frame]:
        drive = unit.drive
        before = drive.tick
        table_rad_s = drive.physics.table_speed_rad_s
        frames = drive.receive_frame(SYNC, data)
        if drive.tick == before:
            return frames
        frames += self.tables.sample_axis(drive, table_rad_s)
        received = drive.pdo.previous_received_numbers
        unit.offsets.count_cycle(not received.isdisjoint(drive.pdo.offset_rpdos))
        for key in self._listed:
            if key[0] == unit.axis:
                self._streams[key].count_cycle(key[1] in received)
        return frames

    def _inject_foreign_frames(self, bus: str) -> list[Frame]:
        frames: list[Frame] = []
        for can_id, (where, data) in self._injected.items():
            if where == bus:
                frames.append((can_id, data))
                for unit in self._of_bus[bus]:
                    frames += unit.drive.receive_frame(can_id, data)
        return frames

    def _signal_rapid(self, on: bool) -> None:
        self._rapid = on
        for unit in self.units.values():
            unit.set_digital_input(self.config.g0.input_bit, on)

    def _run_faults(self, row: int | None) -> None:
        self._log_started_faults(self.faults.run_due_faults(self.tick, row))

    def _log_started_faults(self, started: list[FaultEntry]) -> None:
        for entry in started:
            self.events.append({"event": "fault", "sync": self.tick, **entry.model_dump(exclude_none=True)})

    def is_waiting_for_rpdo(self) -> bool:
        """Whether an RPDO of this cycle is still missing (lockstep)."""
        if self._listed:
            return any(
                stream.is_awaited and number not in self.units[axis].drive.pdo.sent_numbers
                for (axis, number), stream in self._streams.items()
            )
        return any(unit.drive.pdo.previous_sent_numbers - unit.drive.pdo.sent_numbers for unit in self.units.values())

    def has_offset_in_force(self) -> bool:
        """Whether a drive holds a nonzero offset of position, speed or torque: its sender is active."""
        return any(unit.drive.dictionary.get_number(i, 0) for unit in self.units.values() for i in OFFSET_OBJECTS)

    def record_next_file(self, path: Path) -> None:
        self._next_trace = path

    def _record_row(self, row: PathRow | None) -> None:
        if row is None:
            return
        self._row += 1
        if self._recorder is None:
            return
        values = [
            (reference, unit.drive.table_mm, unit.drive.offset_mm * 1e3)
            for reference, unit in zip(row.position_mm, self.units.values(), strict=True)
        ]
        try:
            self._recorder.write_row(values)
        except StoreError as error:
            self._recorder.abandon_file()
            self._recorder = None
            self.events.append({"event": "error", "text": str(error)})

    def take_events(self) -> list[Event]:
        if self.nc.events:
            self._complete_events()
        events, self.events = self.events, []
        return events

    def _complete_events(self) -> None:
        """Complete the NC's events; a file that comes into force starts the counters and the trace."""
        for event in self.nc.events:
            if event["event"] == "playing":
                self._start_file()
            elif event["event"] == "finished":
                event["late_rpdo"] = {axis: unit.offsets.late for axis, unit in self.units.items()}
                event["trace"] = self._close_trace()
            self.events.append(event)
        self.nc.events.clear()

    def _start_file(self) -> None:
        self._row = 0
        for unit in self.units.values():
            unit.offsets.late = 0
        if self._next_trace is None:
            return
        try:
            self._recorder = TraceRecorder(self._next_trace, tuple(self.units), self.period_s)
        except StoreError as error:
            self.events.append({"event": "error", "text": str(error)})
        self._next_trace = None

    def _close_trace(self) -> str | None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return None
        try:
            recorder.finish_file()
        except StoreError as error:
            self.events.append({"event": "error", "text": str(error)})
            return None
        return str(recorder.path)

    def abandon_trace(self) -> None:
        if self._recorder is not None:
            self._recorder.abandon_file()
            self._recorder = None


def _parse_lockstep_rpdo(text: str, units: Mapping[str, SimulatedAxis]) -> tuple[str, int]:
    axis, _, number = text.partition(":")
    if axis not in units or number not in map(str, units[axis].drive.pdo.list_numbers("rpdo")):
        fault = ConfigFault(
            "sim.lockstep_rpdo", f"{text!r} is not an RPDO of this machine", "write axis and number, such as X:2"
        )
        raise ConfigError("config", [fault])
    return axis, int(number)
