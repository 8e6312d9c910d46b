"""Simulates a CiA 402 servo drive on a CANopen bus, sans-I/O: frames in, frames out.

At SYNC k the drive latches the RPDOs received since SYNC k-1, samples all objects at t_k, sends the due TPDOs, and
integrates [t_k, t_k+1). It follows the 0x607A and 0x60B0 latched at SYNC k at t_k+delay. Heartbeats and time-outs run
on the time given to :meth:`Drive.wall_clock`; without a leading SYNC the motion does, too.
"""

from collections.abc import Callable

import numpy as np

from fdhil.config import MachineConfig, SimAxis
from fdhil.sim.drive.axis_plant import AxisPlant, locate_switches, select_sensor_noise
from fdhil.sim.drive.canopen_node import OPERATIONAL, CanopenNode
from fdhil.sim.drive.drive_cycle import DriveCycle
from fdhil.sim.drive.drive_objects import DriveRatings
from fdhil.sim.drive.drive_oscillator import DriveOscillator
from fdhil.sim.drive.drive_sensors import DriveFaults, DriveSensors
from fdhil.sim.drive.emergency_and_heartbeat import FOLLOWING_ERROR
from fdhil.sim.drive.feedback import INT16, Feedback, clip_to_integer
from fdhil.sim.drive.object_dictionary import ObjectDictionary
from fdhil.sim.drive.object_write_rules import register_write_rules
from fdhil.sim.drive.plant_physics import PlantPhysics, check_structure
from fdhil.sim.drive.power_stage import PowerStage
from fdhil.sim.drive.real_plant import apply_real_loops
from fdhil.sim.drive.setpoint_selection import SetpointSelector
from fdhil.sim.drive.setpoints import CyclicSetpoints
from fdhil.sim.drive.vendor_emulation import emulate_vendor, track_speed_unit
from fdhil.sim.frame_types import Frame

_MOST_CYCLES_PER_SYNC = 1000


class SimulatedDrive(CanopenNode):
    """One axis' drive with its motor and table.

    ``faults`` may be changed at any time. ``physics`` holds the true current, speed and voltage after the integrated
    cycle. ``nmt`` is the NMT state as in a heartbeat, -1 while the drive has no supply.
    """

    def __init__(self, axis: str, config: MachineConfig, rng: np.random.Generator) -> None:
        section = config.axis[axis]
        check_structure(axis, section.regulators)
        sim_axis = config.sim.axis.get(axis, SimAxis())
        self.axis = axis
        self.ratings = DriveRatings.read_from_config(config, axis)
        self._plant = AxisPlant(config, axis, sim_axis)
        real = apply_real_loops(sim_axis.reality, section.regulators)
        self.emulation = emulate_vendor(config, axis)
        objects = ObjectDictionary(self.emulation.objects, self.emulation.within)
        track_speed_unit(objects, self.emulation, self.ratings)
        super().__init__(objects, self.ratings.node_id, DriveFaults(), boot_s=sim_axis.boot_s)
        self.power = PowerStage(self.dictionary.get_number)
        self.motion = SetpointSelector(
            self.dictionary,
            self.power,
            self.ratings,
            self.faults,
            CyclicSetpoints(
                section.drive.setpoint_delay_cycles, config.machine.sync_period_s, sim_axis.offset_in_feedforward
            ),
            locate_switches(sim_axis, self.ratings),
            (real.position_gain_per_s, real.speed_feedforward),
        )
        self.feedback = Feedback(
            self.dictionary,
            self.ratings,
            real,
            self.physics,
            self.power,
            self.motion,
            DriveSensors(select_sensor_noise(config, sim_axis), self.faults, rng),
            self.emulation.gauges,
        )
        self._cycle = DriveCycle(
            self.dictionary, self.ratings, self._plant, self.power, self.motion, self.feedback, self.faults
        )
        self._clock = DriveOscillator(self.ratings.sync_period_s)
        self._configured_period = (0, 0)
        register_write_rules(
            self.dictionary,
            changeable=self._is_pre_operational,
            powered=lambda: self.power.powered,
            stored=self._stored,
            trace=self.feedback.trace,
            on_controlword=self._apply_received_objects,
            on_communication=self._update_sync_id,
        )

    @property
    def physics(self) -> PlantPhysics:
        """The axis' mechanics and loops."""
        return self._plant.physics

    @property
    def tick(self) -> int:
        return self._cycle.tick

    @property
    def table_mm(self) -> float:
        """The true table position at the start of the cycle, in the axis' direction."""
        return self._cycle.table_mm

    def set_cycle_callback(self, ended: Callable[[float], None]) -> None:
        """Set the callback that is called after each cycle with the mean voltage of the cycle before it."""
        self._cycle.on_cycle_end = ended

    def power_on(self) -> list[Frame]:
        """Boot or reboot with the power-on values, to pre-operational; return the boot-up message if sent at once.

        The first boot sends it at once: the machine is taken as switched on before.
        """
        self._take_node_id()
        self._stored.restore_entries(lambda _: True)
        self.power.enter_switch_on_disabled()
        self.motion.reset_position(self.feedback.true_position)
        self.feedback.following_error = False
        self._cycle.reset_supervision()
        self.set_temperature(self._plant.celsius)
        self.feedback.sample_objects(self.tick)
        self.feedback.update_status_objects()
        self.feedback.trace.clear_rows()
        return self._begin_boot()

    def power_off(self) -> None:
        """Cut the supply: no frame is sent or answered, the axis coasts, until :meth:`power_on`."""
        super().power_off()
        self.power.enter_switch_on_disabled()

    def run_timers(self, now_s: float, *, alone: bool = True) -> list[Frame]:
        """Run what depends on time: heartbeats both ways, time-outs, event-driven TPDOs, self-clocked motion.

        ``alone`` is False where SYNC is the only clock of the machine.
        """
        self._now_s = now_s
        self.dictionary.numbers[0x101300] = round(now_s * 1e6) & 0xFFFFFFFF
        self._run_self_clocked_cycles(now_s, alone)
        return self._run_due_timers()

    def _run_sync_cycle(self, counter: int | None) -> list[Frame]:
        cycles = self._read_cycles_per_sync()
        leads, operational = self._clock.accept_sync(cycles) or self._cycle.is_at_standstill, self.nmt == OPERATIONAL
        if operational:
            self.pdo.latch_rpdos()
        self.motion.synced = True
        if leads:
            self._begin_cycle()
        else:
            self._apply_received_objects()
        frames = self.pdo.collect_sync_tpdos(counter, self._now_s) if operational else []
        if leads:
            self._cycle.integrate_cycle()
            for _ in range(cycles - 1):
                self._begin_cycle()
                self._cycle.integrate_cycle()
        return frames + self._take_outgoing() if self._emergencies.waiting else frames

    def _read_cycles_per_sync(self) -> int:
        """Return the configured number of drive cycles per SYNC, from 0x60C2."""
        period = self.dictionary.numbers.get(0x60C201, 0), self.dictionary.numbers.get(0x60C202, 0)
        if period != self._configured_period:
            self._configured_period = period
            cycles = period[0] * 10.0 ** period[1] / self.ratings.sync_period_s
            self.motion.interpolation.cycles = round(min(max(cycles, 1.0), _MOST_CYCLES_PER_SYNC))
        return self.motion.interpolation.cycles

    def _coast_through_sync(self) -> None:
        if self._clock.accept_sync() or self._cycle.is_at_standstill:
            self._cycle.integrate_cycle()

    @property
    def is_self_clocked(self) -> bool:
        return self._clock.leads and not self._cycle.is_at_standstill

    def _run_self_clocked_cycles(self, now_s: float, alone: bool) -> None:
        if not alone:
            self._clock.follow_sync_only()
            return
        declared_us = self.dictionary.numbers.get(0x100600, 0)
        cycles = self._read_cycles_per_sync()
        bound = self.motion.is_sync_bound and declared_us in (0, round(cycles * self.ratings.sync_period_s * 1e6))
        for _ in range(self._clock.count_due_cycles(now_s, bound=bound, cycles=cycles)):
            self.run_unsynced_cycle()

    def run_unsynced_cycle(self) -> None:
        """Run a cycle on the set-points latched last; skipped at standstill."""
        if self._cycle.is_at_standstill:
            return
        if not self._is_mute:
            self._begin_cycle()
        self._cycle.integrate_cycle()

    def _begin_cycle(self) -> None:
        """Apply the set-points, sample all objects, and supervise."""
        self._cycle.keep_offset()
        self._evaluate_controlword()
        if self._cycle.begin_cycle():
            self.feedback.following_error = True
            self.trip_fault(FOLLOWING_ERROR)
        self.feedback.update_status_objects()

    def _evaluate_controlword(self) -> None:
        word = self.dictionary.numbers[0x604000]
        if self.power.evaluate_controlword(word):
            self.feedback.following_error = False
            self.dictionary.numbers[0x603F00] = 0
            self._emergencies.clear_errors()
        self.motion.evaluate_controlword(word)

    def _apply_received_objects(self) -> None:
        self._evaluate_controlword()
        self.feedback.update_status_objects()

    def trip_fault(self, code: int, detail: bytes = b"") -> None:
        """Enter the fault state with this error code: EMCY with the next frames, reaction by 0x605E."""
        self.dictionary.numbers[0x603F00] = code
        self._emergencies.report_error(code, detail)
        self.power.enter_fault()
        self.feedback.update_status_objects()

    @property
    def _in_fault(self) -> bool:
        return self.power.is_faulty

    def _react_to_lost_connection(self, code: int) -> None:
        if self.dictionary.get_number(0x6007) == 1:
            self.dictionary.numbers[0x603F00] = code
            self.power.enter_fault()
        self._abort_connection()

    def _abort_connection(self) -> None:
        """React by 0x6007 while current flows: nothing, fault, disable voltage, quick stop."""
        if self.power.powered:
            reactions = {1: self.power.enter_fault, 2: self.power.disable_voltage, 3: self.power.start_quick_stop}
            reactions.get(self.dictionary.get_number(0x6007), lambda: None)()
        self.feedback.update_status_objects()

    def set_parameters(self, **values: float) -> None:
        """Change plant parameters (R, L, K, Jt, ft, Cd at the reference temperature) from the next cycle on.

        TypeError for another name, ValueError for an unphysical value.
        """
        self._plant.set_parameters(**values)

    def set_temperature(self, celsius: float) -> None:
        """Set the slide-way's temperature: 0x2110 reports it, ft and Cd follow it."""
        self.dictionary.numbers[0x211001] = clip_to_integer(celsius * 100, INT16)
        self._plant.set_temperature(celsius)

    def overwrite_object(self, index: int, sub: int, value: int) -> None:
        """Overwrite an object regardless of its access rules, as another tool might; KeyError if unknown."""
        entry = self.dictionary.entries[index << 8 | sub]
        self.dictionary.numbers[entry.storage_key] = entry.convert_from_counts(value)

    def overwrite_mapping(self, index: int, entries: list[tuple[int, int, int]]) -> None:
        """Change a mapping parameter (0x1600 to 0x1603, 0x1A00 to 0x1A03) regardless of the rules."""
        self.overwrite_object(index, 0, len(entries))
        for sub, (mapped, mapped_sub, bits) in enumerate(entries, 1):
            self.overwrite_object(index, sub, mapped << 16 | mapped_sub << 8 | bits)
        if self.nmt == OPERATIONAL:
            self.pdo.configure_pdos()

    @property
    def reference_mm(self) -> float:
        """The demand r[k] in force at the last SYNC, without offset."""
        return self.ratings.sign * self.motion.cyclic.current.position / self.ratings.increments_per_mm

    @property
    def offset_mm(self) -> float:
        """The position offset o[k] in force at the last SYNC."""
        return self.ratings.sign * self.motion.cyclic.current.offset / self.ratings.increments_per_mm
