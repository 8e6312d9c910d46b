"""Simulates a CiA 402 servo drive on a CANopen bus, sans-I/O: frames in, frames out, physics by SYNC.

At SYNC k the drive latches the RPDOs it received since SYNC k-1, samples all objects at t_k, sends the TPDOs that are
due, and integrates [t_k, t_k+1). The 0x607A and 0x60B0 latched at SYNC k are what it follows at t_k+delay. Heartbeats
and time-outs run on the wall time that :meth:`Drive.wall_clock` is given.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fdhil.config import MachineConfig, Noise, SimAxis
from fdhil.records import PARAMETERS, Parameters
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
)
from fdhil.sim.drive.feedback import INT16, Feedback, clip
from fdhil.sim.drive.motion import Motion
from fdhil.sim.drive.object_write_rules import StoredParameters, register_write_rules
from fdhil.sim.drive.objects import NO_WINDOW, Ratings
from fdhil.sim.drive.pdo import PdoEngine
from fdhil.sim.drive.physics import Physics, check_structure, true_parameters
from fdhil.sim.drive.power import PowerStage, State
from fdhil.sim.drive.reality import RealPhysics, is_plain, real_loops
from fdhil.sim.drive.sdo import SdoServer
from fdhil.sim.drive.sensors import DriveFaults, Sensors
from fdhil.sim.drive.setpoints import CyclicSetpoints
from fdhil.sim.frame import Frame

OFF, STOPPED, OPERATIONAL, PRE_OPERATIONAL = -1, 0x04, 0x05, 0x7F


def _physics(parameters: Parameters, config: MachineConfig, axis: str, twin: SimAxis, rad_per_mm: float) -> Physics:
    """Make the axis' mechanics and loops: the paper's, or a real machine's where the configuration names any of it."""
    section = config.axis[axis]
    increments, period_s = section.drive.increments_per_rev, config.machine.sync_period_s
    start_rad, backlash_rad = twin.start_mm * rad_per_mm, abs(twin.backlash_um * 1e-3 * rad_per_mm)
    loops = section.regulators
    if is_plain(twin.reality, loops):
        return Physics(parameters, loops, period_s, increments, angle_rad=start_rad, backlash_rad=backlash_rad)
    return RealPhysics(
        parameters, loops, period_s, increments, twin.reality,
        rad_per_mm=rad_per_mm, angle_rad=start_rad, backlash_rad=backlash_rad,
    )  # fmt: skip


def _noise(config: MachineConfig, twin: SimAxis) -> Noise:
    """Return the sensors' white noise: a speed that is made of encoder positions has none of its own."""
    white = twin.reality.speed_object == "shaft"
    return config.sim.noise if white else config.sim.noise.model_copy(update={"speed_rad_s": 0.0})


class Drive:
    """One axis' drive with its motor and table.

    ``faults`` may be changed at any time. ``table_mm`` is the true table position at the last SYNC, in the axis'
    direction; ``physics`` holds the true current, speed and voltage after the cycle that was integrated.
    ``nmt`` is the NMT state as a heartbeat shows it, -1 while the drive is without supply.
    """

    def __init__(self, axis: str, config: MachineConfig, rng: np.random.Generator) -> None:
        section = config.axis[axis]
        check_structure(axis, section.regulators)
        twin = config.sim.axis.get(axis, SimAxis())
        self.axis = axis
        self.ratings = Ratings.of(config, axis)
        self.node_id = self.ratings.node_id
        self.faults = DriveFaults()
        self._mm_per_rad = self.ratings.sign * section.screw_pitch_mm / (2 * math.pi)
        real = real_loops(twin.reality, section.regulators)
        self._reference_c = self._celsius = config.sim.thermal.ambient_c
        self._per_kelvin = (twin.ft_per_kelvin, twin.Cd_per_kelvin)
        self._parameters = true_parameters(section.nominal, twin)
        self.physics = _physics(self._parameters, config, axis, twin, 1 / self._mm_per_rad)
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
        )
        self.feedback = Feedback(
            self.dictionary,
            self.ratings,
            real,
            self.physics,
            self.power,
            self.motion,
            Sensors(_noise(config, twin), self.faults, rng),
            self.dress.gauges,
        )
        self._attach()

    def _attach(self) -> None:
        """Make the communication side on top of the object dictionary."""
        self.nmt = OFF
        self.tick = 0
        self.table_mm = self.physics.table_rad * self._mm_per_rad
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
        self._stored = StoredParameters(self.dictionary)
        register_write_rules(
            self.dictionary,
            changeable=self._is_pre_operational,
            stored=self._stored,
            trace=self.feedback.trace,
            on_controlword=self._controlword_written,
            on_communication=self._communication_changed,
        )

    def _is_pre_operational(self) -> bool:
        return self.nmt == PRE_OPERATIONAL

    # -- life

    def power_on(self) -> list[Frame]:
        """Boot, or boot again: the power-on values, pre-operational; returns the boot-up message."""
        self._stored.restore(lambda _: True)
        self.power.start()
        self.motion.reset(self.feedback.true_position)
        self.feedback.following_error = False
        self._over_window = self._last_offset = 0
        self._outgoing = []
        self.set_temperature(self._celsius)
        self.feedback.sample(self.tick)
        self.feedback.show_state()
        self.feedback.trace.clear()
        return self._boot_up()

    def power_off(self) -> None:
        """Cut the supply: no frame is sent or answered, the axis coasts; :meth:`power_on` ends it."""
        self.nmt = OFF
        self.pdo.stop()
        self.power.start()

    def _boot_up(self) -> list[Frame]:
        self.nmt = PRE_OPERATIONAL
        self.pdo.stop()
        self._sdo.reset()
        self._consumer.configure()
        self._producer.restart()
        self._communication_changed()
        return [(0x700 + self.node_id, b"\0")]

    def _communication_changed(self) -> None:
        self._sync_id = self.dictionary.number(0x1005) & 0x7FF

    def wall_clock(self, now_s: float) -> list[Frame]:
        """Run what depends on time and not on SYNC: heartbeats both ways, RPDO time-outs, event-driven TPDOs."""
        self._now_s = now_s
        if self.nmt == OFF:
            return []
        frames = self._producer.due(now_s, self.nmt)
        if not self.faults.no_heartbeat_consumer:
            for node in self._consumer.expired(now_s):
                self._connection_lost(HEARTBEAT_LOST, bytes([node]))
        for number in self.pdo.overdue(now_s):
            self._connection_lost(RPDO_TIMEOUT, bytes([number]))
        return frames + self._take_outgoing() + self.pdo.on_events(now_s)

    # -- frames

    def receive(self, can_id: int, data: bytes) -> list[Frame]:
        """Take one frame from the bus and return what the drive sends because of it."""
        if can_id == self._sync_id:
            return self._sync(data)
        if self.nmt == OFF:
            return []
        if can_id == 0x600 + self.node_id:
            return self._sdo_request(data)
        if can_id == 0x000:
            return self._nmt(data)
        if can_id > 0x700:
            back = len(data) == 1 and self._consumer.receive(can_id - 0x700, self._now_s)
            return self._emergencies.clear(in_fault=self.power.faulty) if back else []
        return self._rpdo(can_id, data) if self.nmt == OPERATIONAL else []

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
                self.pdo.stop()
                self.nmt = STOPPED
                self._abort_connection()
            case 0x80:
                self.pdo.stop()
                self.nmt = PRE_OPERATIONAL
            case 0x81:
                return self.power_on()
            case 0x82:
                self._abort_connection()
                self._stored.restore(lambda entry: entry.index < 0x2000)
                return self._boot_up() + self._take_outgoing()
        return self._take_outgoing()

    def _rpdo(self, can_id: int, data: bytes) -> list[Frame]:
        try:
            at_once = self.pdo.receive(can_id, data, self._now_s)
        except LookupError:
            return []
        except ValueError:
            return self._emergencies.report(PDO_TOO_SHORT)
        if at_once is not None:
            self.pdo.apply(at_once)
            self._controlword_written()
        return self._take_outgoing()

    def _take_outgoing(self) -> list[Frame]:
        frames, self._outgoing = self._outgoing, []
        return frames

    # -- the SYNC cycle

    def _sync(self, data: bytes) -> list[Frame]:
        if self.nmt == OFF:
            self._integrate()
            return []
        counter = data[0] if data else None
        if counter is None and self.dictionary.numbers[0x101900]:
            told, self._sync_refused = self._sync_refused, True
            return [] if told else self._emergencies.report(SYNC_LENGTH)
        self._sync_refused = False
        operational = self.nmt == OPERATIONAL
        if operational:
            self.pdo.latch()
        self._keep_offset()
        self._control()
        self.motion.at_sync(self.feedback.true_position)
        self._supervise(self.feedback.sample(self.tick))
        self.feedback.show_state()
        self.table_mm = self.physics.table_rad * self._mm_per_rad
        frames = self.pdo.at_sync(counter, self._now_s) if operational else []
        self._integrate()
        return frames + self._take_outgoing() if self._outgoing else frames

    def _integrate(self) -> None:
        self.physics.load_torque_nm = float(self.faults.load_torque_nm)
        self.physics.cycle(self.power.powered, self.motion.command)
        self.tick += 1

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
        unknown = [name for name in values if name not in PARAMETERS]
        if unknown:
            raise TypeError(f"{', '.join(unknown)} is no parameter of a drive")
        changed = self._parameters.changed(**values)
        for name, value in changed.as_dict().items():
            if not (math.isfinite(value) and value >= 0 and (value > 0 or name in ("ft", "Cd"))):
                raise ValueError(f"{name} = {value} is no value of a feed drive; it must be finite and above 0")
        self._parameters = changed
        self._apply_parameters()

    def set_temperature(self, celsius: float) -> None:
        """Set the slide-way's temperature: 0x2110 shows it, ft and Cd follow it."""
        self._celsius = celsius
        self.dictionary.numbers[0x211001] = clip(celsius * 100, INT16)
        self._apply_parameters()

    def _apply_parameters(self) -> None:
        rise = self._celsius - self._reference_c
        ft, Cd = (max(1 + rate * rise, 0.0) for rate in self._per_kelvin)
        base = self._parameters
        now = replace(base, ft=base.ft * ft, Cd=base.Cd * Cd)
        if now != self.physics.parameters:
            self.physics.set_parameters(now)

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
