"""Simulates a CiA 402 servo drive on a CANopen bus, sans-I/O: frames in, frames out.

At SYNC k the drive latches the RPDOs it received since SYNC k-1, samples all objects at t_k, sends the TPDOs that are
due, and integrates [t_k, t_k+1). The 0x607A and 0x60B0 latched at SYNC k are what it follows at t_k+delay. Heartbeats
and time-outs run on the time that :meth:`Drive.wall_clock` is given, and where no SYNC leads so does the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fdhil.config import MachineConfig, SimAxis
from fdhil.sim.drive import lss
from fdhil.sim.drive.axis_plant import AxisPlant, sensor_noise, switches
from fdhil.sim.drive.dictionary import Dictionary
from fdhil.sim.drive.dress import dress
from fdhil.sim.drive.emergency_and_heartbeat import (
    FOLLOWING_ERROR,
    HEARTBEAT_LOST,
    PDO_TOO_SHORT,
    RPDO_TIMEOUT,
    SYNC_LENGTH,
    Emergencies,
    HeartbeatConsumer,
    HeartbeatProducer,
    NodeGuarding,
)
from fdhil.sim.drive.feedback import INT16, Feedback, clip
from fdhil.sim.drive.motion import Motion
from fdhil.sim.drive.motion_objects import NO_WINDOW
from fdhil.sim.drive.object_write_rules import StoredParameters, register_write_rules
from fdhil.sim.drive.objects import Ratings
from fdhil.sim.drive.own_clock import OwnClock
from fdhil.sim.drive.pdo import PdoEngine
from fdhil.sim.drive.physics import Loops, Physics, check_structure
from fdhil.sim.drive.power import PowerStage, State
from fdhil.sim.drive.reality import real_loops
from fdhil.sim.drive.sdo import SdoServer
from fdhil.sim.drive.sensors import DriveFaults, Sensors
from fdhil.sim.drive.service_objects import KEEP_STATE
from fdhil.sim.drive.setpoints import CyclicSetpoints
from fdhil.sim.frame import Frame

OFF, INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = -1, 0x00, 0x04, 0x05, 0x7F
_AFTER_ERROR = {0: PRE_OPERATIONAL, 2: STOPPED}  # 0x1029: the NMT state after a communication error; 1: as it is
_CREEP_RAD_S = 1e-6  # slower than this an axis without power stands


class Drive:
    """One axis' drive with its motor and table.

    ``faults`` may be changed at any time. ``table_mm`` is the true table position at the start of the cycle, in the
    axis' direction; ``physics`` holds the true current, speed and voltage after the cycle that was integrated.
    ``nmt`` is the NMT state as a heartbeat shows it, -1 while the drive is without supply. ``cycle_ended`` is called
    after each cycle, with the mean voltage of the one before it.
    """

    def __init__(self, axis: str, config: MachineConfig, rng: np.random.Generator) -> None:
        section = config.axis[axis]
        check_structure(axis, section.regulators)
        twin = config.sim.axis.get(axis, SimAxis())
        self.axis = axis
        self.ratings = Ratings.of(config, axis)
        self.node_id = self.ratings.node_id
        self.faults = DriveFaults()
        self._boot_s = twin.boot_s
        self._plant = AxisPlant(config, axis, twin)
        real = real_loops(twin.reality, section.regulators)
        self.dress = dress(config, axis)
        self.dictionary = Dictionary(self.dress.objects, self.dress.within)
        self.power = PowerStage(self.dictionary.number)
        self.motion = Motion(
            self.dictionary,
            self.power,
            self.ratings,
            self.faults,
            CyclicSetpoints(
                section.drive.setpoint_delay_cycles, config.machine.sync_period_s, twin.offset_in_feedforward
            ),
            switches(twin, self.ratings),
            (real.position_gain_per_s, real.speed_feedforward),
        )
        self.feedback = Feedback(
            self.dictionary,
            self.ratings,
            real,
            self.physics,
            self.power,
            self.motion,
            Sensors(sensor_noise(config, twin), self.faults, rng),
            self.dress.gauges,
        )
        self._attach()

    def _attach(self) -> None:
        """Make the communication side on top of the object dictionary."""
        self.nmt = OFF
        self.tick = 0
        self.table_mm = self._true_table_mm
        self.cycle_ended: Callable[[float], None] | None = None
        self._clock = OwnClock(self.ratings.sync_period_s)
        self._loops = Loops.POSITION
        self._current_limit = self._limit_objects
        self._boot_due_s: float | None = None
        self._has_booted = False
        self._told_s: float | None = None
        self._sync_id = 0x80
        self._sync_refused = False
        self._now_s = 0.0
        self._over_window = 0
        self._last_offset = 0
        self._outgoing: list[Frame] = []
        self.pdo = PdoEngine(self.dictionary, self._is_pre_operational, self.faults.drop_tpdo)
        self._sdo = SdoServer(self.dictionary)
        self._emergencies = Emergencies(self.dictionary)
        self._consumer = HeartbeatConsumer(self.dictionary)
        self._producer = HeartbeatProducer(self.dictionary, self.node_id)
        self._guarding = NodeGuarding(self.dictionary)
        self._lss = lss.LssSlave(self.node_id, self._identity)
        self._stored = StoredParameters(self.dictionary)
        register_write_rules(
            self.dictionary,
            changeable=self._is_pre_operational,
            powered=lambda: self.power.powered,
            stored=self._stored,
            trace=self.feedback.trace,
            on_controlword=self._controlword_written,
            on_communication=self._communication_changed,
        )

    def _is_pre_operational(self) -> bool:
        return self.nmt == PRE_OPERATIONAL

    def _identity(self) -> tuple[int, int, int, int]:
        vendor, product, revision, serial = (self.dictionary.numbers.get(0x101800 | sub, 0) for sub in (1, 2, 3, 4))
        return vendor, product, revision, serial

    @property
    def physics(self) -> Physics:
        """The axis' mechanics and loops."""
        return self._plant.physics

    @property
    def _mute(self) -> bool:
        """Without supply, or not yet booted."""
        return self.nmt in (OFF, INITIALISING)

    # -- life

    def power_on(self) -> list[Frame]:
        """Boot, or boot again: the power-on values, pre-operational; returns the boot-up message, if it comes at once.

        The very first time it does: nobody waits for a machine that was switched on before.
        """
        self._take_node_id()
        self._stored.restore(lambda _: True)
        self.power.start()
        self.motion.reset(self.feedback.true_position)
        self.feedback.following_error = False
        self._over_window = self._last_offset = 0
        self.set_temperature(self._plant.celsius)
        self.feedback.sample(self.tick)
        self.feedback.show_state()
        self.feedback.trace.clear()
        return self._boot_up()

    def power_off(self) -> None:
        """Cut the supply: no frame is sent or answered, the axis coasts; :meth:`power_on` ends it."""
        self.nmt = OFF
        self._boot_due_s = None
        self.pdo.stop()
        self.power.start()
        self._lss.power_on()

    def _boot_up(self) -> list[Frame]:
        self.nmt = INITIALISING
        self.pdo.stop()
        self._sdo.reset()
        self._outgoing = []
        self._consumer.configure()
        self._producer.restart()
        self._guarding.reset()
        self._lss.reset()
        self._communication_changed()
        if self.node_id == lss.UNCONFIGURED:
            return []
        if self._boot_s and self._has_booted:
            self._boot_due_s = self._now_s + self._boot_s
            return []
        return self._booted()

    def _booted(self) -> list[Frame]:
        self.nmt = PRE_OPERATIONAL
        self._boot_due_s, self._has_booted = None, True
        return [(0x700 + self.node_id, b"\0")]

    def _take_node_id(self) -> None:
        """Take over the node-ID that LSS has given."""
        new, old = self._lss.pending, self.node_id
        if new == old:
            return
        self.dictionary.renumber(new - old)
        self.node_id = self._lss.node_id = new
        self.ratings = replace(self.ratings, node_id=new)
        self._producer = HeartbeatProducer(self.dictionary, new)

    def _communication_changed(self) -> None:
        self._sync_id = self.dictionary.number(0x1005) & 0x7FF

    def wall_clock(self, now_s: float, *, alone: bool = True) -> list[Frame]:
        """Run what depends on time and not on SYNC: heartbeats both ways, time-outs, event-driven TPDOs, own motion.

        ``alone`` is False where SYNC is the only clock of the machine.
        """
        self._now_s = now_s
        self.dictionary.numbers[0x101300] = round(now_s * 1e6) & 0xFFFFFFFF
        self._move_alone(now_s, alone)
        frames = self._booted() if self._boot_due_s is not None and now_s >= self._boot_due_s else []
        if self._mute:
            return []
        frames += self._producer.due(now_s, self.nmt)
        if not self.faults.no_heartbeat_consumer:
            for node in self._consumer.expired(now_s):
                self._connection_lost(HEARTBEAT_LOST, bytes([node]))
        if self._guarding.expired(now_s):
            self._connection_lost(HEARTBEAT_LOST, b"")
        for number in self.pdo.overdue(now_s):
            self._connection_lost(RPDO_TIMEOUT, bytes([number]))
        return frames + self._take_outgoing() + self.pdo.on_events(now_s)

    # -- frames

    def receive(self, can_id: int, data: bytes) -> list[Frame]:
        """Take one frame from the bus and return what the drive sends because of it; one without data asks for one."""
        if can_id == self._sync_id:
            return self._sync(data)
        if can_id == lss.REQUEST and self.nmt not in (OFF, OPERATIONAL):
            answer = self._lss.receive(data)
            return [] if answer is None else [(lss.RESPONSE, answer)]
        if self._mute:
            return []
        if can_id == 0x600 + self.node_id:
            return self._sdo_request(data)
        if can_id == 0x000:
            return self._nmt(data)
        if can_id == 0x700 + self.node_id:
            return [] if data else [(can_id, self._guarding.request(self.nmt, self._now_s))]
        if can_id > 0x700:
            if len(data) == 1 and self._consumer.receive(can_id - 0x700, self._now_s):
                self._outgoing += self._emergencies.clear(in_fault=self.power.faulty)
            return self._take_outgoing()
        if self.nmt != OPERATIONAL:
            return []
        return self._rpdo(can_id, data) if data else self.pdo.requested(can_id)

    def _sdo_request(self, data: bytes) -> list[Frame]:
        if self.nmt == STOPPED:
            return []
        answers: list[Frame] = [(0x580 + self.node_id, answer) for answer in self._sdo.request(data)]
        return answers + self._take_outgoing()

    def _nmt(self, data: bytes) -> list[Frame]:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return []
        match data[0]:
            case 0x01 if self.nmt != OPERATIONAL:
                self.nmt = OPERATIONAL
                self.pdo.configure()
            case 0x02:
                self._leave_operational(STOPPED)
                self._abort_connection()
            case 0x80:
                self._leave_operational(PRE_OPERATIONAL)
            case 0x81:
                return self.power_on()
            case 0x82:
                self._abort_connection()
                self._take_node_id()
                self._stored.restore(lambda entry: entry.index < 0x2000)
                return self._boot_up()
        return self._take_outgoing()

    def _leave_operational(self, state: int) -> None:
        self.pdo.stop()
        self.nmt = state

    def _rpdo(self, can_id: int, data: bytes) -> list[Frame]:
        try:
            at_once = self.pdo.receive(can_id, data, self._now_s)
        except LookupError:
            return []
        except ValueError:
            self._outgoing += self._emergencies.report(PDO_TOO_SHORT)
            return self._take_outgoing()
        if at_once is not None:
            self.pdo.apply(at_once)
            self._controlword_written()
        return self._take_outgoing()

    def _take_outgoing(self) -> list[Frame]:
        """Return the EMCY frames that may leave now: none in NMT stopped, and none within the inhibit time 0x1015."""
        if not self._outgoing:
            return []
        if self.nmt == STOPPED or self._mute:
            self._outgoing = []
            return []
        inhibit_s = self.dictionary.numbers.get(0x101500, 0) * 1e-4
        if not inhibit_s:
            frames, self._outgoing = self._outgoing, []
            return frames
        if self._told_s is not None and self._now_s - self._told_s < inhibit_s:
            return []
        self._told_s = self._now_s
        return [self._outgoing.pop(0)]

    # -- the cycle

    def _sync(self, data: bytes) -> list[Frame]:
        leads = self._clock.sync() or self._stands
        if self._mute:
            if leads:
                self._integrate()
            return []
        counter = data[0] if data else None
        if counter is None and self.dictionary.numbers[0x101900]:
            told, self._sync_refused = self._sync_refused, True
            self._outgoing += [] if told else self._emergencies.report(SYNC_LENGTH)
            return self._take_outgoing()
        self._sync_refused = False
        operational = self.nmt == OPERATIONAL
        if operational:
            self.pdo.latch()
        if leads:
            self._begin_cycle()
        else:
            self._controlword_written()
        frames = self.pdo.at_sync(counter, self._now_s) if operational else []
        if leads:
            self._integrate()
        return frames + self._take_outgoing() if self._outgoing else frames

    @property
    def _stands(self) -> bool:
        """Whether nothing can move: no current flows, and the axis is at rest."""
        return not self.power.powered and abs(self.physics.speed_rad_s) < _CREEP_RAD_S

    @property
    def moves_alone(self) -> bool:
        """Whether the drive moves by its own clock."""
        return self._clock.leads and not self._stands

    def _move_alone(self, now_s: float, alone: bool) -> None:
        """Run the cycles that no SYNC has begun; a drive that stands needs none."""
        if not alone:
            self._clock.stop()
            return
        declared_us = self.dictionary.numbers.get(0x100600, 0)
        bound = self.motion.bound and declared_us in (0, round(self.ratings.sync_period_s * 1e6))
        for _ in range(self._clock.due(now_s, bound=bound)):
            if self._stands:
                return
            if not self._mute:
                self._begin_cycle()
            self._integrate()

    def _begin_cycle(self) -> None:
        """Take the set-points as they are, sample all objects, and supervise."""
        self._keep_offset()
        self._control()
        self.motion.begin_cycle(self.feedback.actual)
        self._supervise(self.feedback.sample(self.tick))
        self.feedback.show_state()
        self.table_mm = self._true_table_mm

    @property
    def _true_table_mm(self) -> float:
        place = self.physics.table_rad * self._plant.mm_per_rad
        shift = self.motion.shift
        return place - self.ratings.sign * shift / self.ratings.increments_per_mm if shift else place

    def _integrate(self) -> None:
        physics, motion = self.physics, self.motion
        ended_v = physics.voltage_mean_v
        if motion.loops is not self._loops:
            self._loops = motion.loops
            physics.close_loops(motion.loops)
        if self._limit_objects != self._current_limit:
            self._current_limit = self._limit_objects
            physics.limit_current(min(self._current_limit) * 1e-3 * self.ratings.rated_current_a)
        command = motion.command
        if motion.shift:
            command = (command[0] + motion.shift, command[1] + motion.shift, *command[2:])
        physics.load_torque_nm = float(self.faults.load_torque_nm)
        physics.cycle(self.power.powered, command)
        self.tick += 1
        if self.cycle_ended is not None:
            self.cycle_ended(ended_v)

    @property
    def _limit_objects(self) -> tuple[int, int]:
        """Max torque and max current, 0.1 % of the rated ones."""
        numbers = self.dictionary.numbers
        return numbers.get(0x607200, 0xFFFF), numbers.get(0x607300, 0xFFFF)

    def _keep_offset(self) -> None:
        """With the fault ``ignore_offset`` what was written to 0x60B0 is lost."""
        numbers = self.dictionary.numbers
        if self.faults.ignore_offset:
            numbers[0x60B000] = self._last_offset
        self._last_offset = numbers[0x60B000]

    def _control(self) -> None:
        word = self.dictionary.numbers[0x604000]
        if self.power.control(word):
            self.feedback.following_error = False
            self.dictionary.numbers[0x603F00] = 0
            self._outgoing += self._emergencies.clear()
        self.motion.control(word)

    def _controlword_written(self) -> None:
        self._control()
        self.feedback.show_state()

    # -- faults and reactions

    def _supervise(self, error: int) -> None:
        """Fault when the following error stays beyond 0x6065 for 0x6066 milliseconds."""
        window = self.dictionary.numbers[0x606500]
        if window == NO_WINDOW or not self.power.powered or abs(error) <= window:
            self._over_window = 0
            return
        self._over_window += 1
        over_ms = (self._over_window - 1) * self.ratings.sync_period_s * 1e3
        if over_ms >= self.dictionary.numbers[0x606600] and self.power.state is not State.FAULT_REACTION_ACTIVE:
            self.feedback.following_error = True
            self.trip(FOLLOWING_ERROR)

    def trip(self, code: int, detail: bytes = b"") -> None:
        """Fall into fault with this error code: EMCY with the next frames, reaction by 0x605E."""
        self.dictionary.numbers[0x603F00] = code
        self._outgoing += self._emergencies.report(code, detail)
        self.power.fault()
        self.feedback.show_state()

    def _connection_lost(self, code: int, detail: bytes) -> None:
        self._outgoing += self._emergencies.report(code, detail)
        if self.dictionary.number(0x6007) == 1:
            self.dictionary.numbers[0x603F00] = code
            self.power.fault()
        state = _AFTER_ERROR.get(self.dictionary.numbers.get(0x102901, KEEP_STATE))
        if state is not None and self.nmt == OPERATIONAL:
            self._leave_operational(state)
        self._abort_connection()

    def _abort_connection(self) -> None:
        """React by 0x6007 while current flows: nothing, fault, disable voltage, quick stop."""
        if self.power.powered:
            reactions = {1: self.power.fault, 2: self.power.disable_voltage, 3: self.power.quick_stop}
            reactions.get(self.dictionary.number(0x6007), lambda: None)()
        self.feedback.show_state()

    # -- what a test or the machine around the drive may turn

    def set_parameters(self, **values: float) -> None:
        """Change plant parameters (R, L, K, Jt, ft, Cd at the reference temperature) from the next cycle on.

        TypeError for another name, ValueError for a value that no plant has.
        """
        self._plant.set_parameters(**values)

    def set_temperature(self, celsius: float) -> None:
        """Set the slide-way's temperature: 0x2110 shows it, ft and Cd follow it."""
        self.dictionary.numbers[0x211001] = clip(celsius * 100, INT16)
        self._plant.warm(celsius)

    def set_object(self, index: int, sub: int, value: int) -> None:
        """Write an object past all access rules, as another tool or a wrong set-up would have; KeyError if unknown."""
        entry = self.dictionary.entries[index << 8 | sub]
        self.dictionary.numbers[entry.place] = entry.number(value)

    def remap(self, index: int, entries: list[tuple[int, int, int]]) -> None:
        """Change a mapping parameter (0x1600 to 0x1603, 0x1A00 to 0x1A03) past all rules, even in operational."""
        self.set_object(index, 0, len(entries))
        for sub, (mapped, mapped_sub, bits) in enumerate(entries, 1):
            self.set_object(index, sub, mapped << 16 | mapped_sub << 8 | bits)
        if self.nmt == OPERATIONAL:
            self.pdo.configure()

    @property
    def reference_mm(self) -> float:
        """The demand r[k] in force at the last SYNC, without offset."""
        return self.ratings.sign * self.motion.cyclic.now.position / self.ratings.increments_per_mm

    @property
    def offset_mm(self) -> float:
        """The position offset o[k] in force at the last SYNC."""
        return self.ratings.sign * self.motion.cyclic.now.offset / self.ratings.increments_per_mm
