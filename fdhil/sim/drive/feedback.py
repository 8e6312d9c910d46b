"""Samples the objects of a drive at a SYNC: positions, speeds, current, voltage, statusword (CiA 402-2)."""

import math

from fdhil.config import Regulators
from fdhil.sim.drive.drive_objects import VOLTAGE_V_PER_COUNT, DriveRatings
from fdhil.sim.drive.drive_sensors import DriveSensors
from fdhil.sim.drive.object_dictionary import ObjectDictionary
from fdhil.sim.drive.open_loop_modes import MeasuredState
from fdhil.sim.drive.plant_physics import PlantPhysics
from fdhil.sim.drive.power_stage import PowerStage
from fdhil.sim.drive.setpoint_selection import SetpointSelector, SetpointSource
from fdhil.sim.drive.trace_buffer import TraceBuffer
from fdhil.sim.drive.vendor_emulation import VendorSignal

_VOLTAGE_ENABLED, _REMOTE, _LIMIT, _FOLLOWING_ERROR = 1 << 4, 1 << 9, 1 << 11, 1 << 13
_LIMIT_SWITCHES = 0b11
INT16, INT32 = 0x7FFF, 0x7FFFFFFF


def clip_to_integer(value: float, highest: int) -> int:
    """Round to a signed integer and limit it to the range with this highest value."""
    whole = round(value)
    if -highest - 1 <= whole <= highest:
        return whole
    return highest if whole > 0 else -highest - 1


class Feedback:
    """Samples a drive's objects and stores them in ``trace``. ``following_error`` is bit 13 of the statusword.

    ``digital_inputs`` is 0x60FD: bits 0 and 1 limit switches, 2 home, 16 the NC's rapid signal; the machine's own
    switches are added.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        ratings: DriveRatings,
        regulators: Regulators,
        physics: PlantPhysics,
        power: PowerStage,
        motion: SetpointSelector,
        sensors: DriveSensors,
        gauges: tuple[VendorSignal, ...] = (),
    ) -> None:
        self._numbers = dictionary.numbers
        self._physics = physics
        self._power = power
        self._motion = motion
        self._sensors = sensors
        self._gauges = gauges
        self._switches = motion.homing.switches if motion.homing.switches.has_switches else None
        self.trace = TraceBuffer()
        self._inc_per_rad = ratings.increments_per_rev / (2 * math.pi)
        self._counts_per_a = 1e3 / ratings.rated_current_a
        self._kv, self._kff = regulators.position_gain_per_s, regulators.speed_feedforward
        self._bus_mv = regulators.voltage_limit_v * 1e3
        self.following_error = False
        self.digital_inputs = 0

    @property
    def true_position(self) -> int:
        """Position feedback of the position loop, increments."""
        return round(self._physics.sensed.position_rad * self._inc_per_rad) - self._motion.shift

    @property
    def inputs(self) -> int:
        """Present value of 0x60FD."""
        if self._switches is None:
            return self.digital_inputs
        return self.digital_inputs | self._switches.read_inputs(self.true_position + self._motion.shift)

    @property
    def actual(self) -> MeasuredState:
        """The drive's feedback without sensor noise."""
        seen = self._physics.sensed
        return MeasuredState(self.true_position, seen.speed_rad_s * self._inc_per_rad, seen.current_a, self.inputs)

    def sample_objects(self, tick: int) -> int:
        """Sample all objects; the voltage is the mean of the ended cycle. Return the following error."""
        physics, numbers = self._physics, self._numbers
        true_position = self.true_position
        seen = physics.sensed
        position, speed, current, voltage = self._sensors.read_signals(
            true_position, seen.speed_rad_s, seen.current_a, seen.voltage_v
        )
        demand = clip_to_integer(self._motion.demand, INT32)
        shown = clip_to_integer(position, INT32)
        speed_counts = clip_to_integer(speed * self._inc_per_rad, INT32)
        current_counts = clip_to_integer(current * self._counts_per_a, INT16)
        voltage_counts = clip_to_integer(voltage / VOLTAGE_V_PER_COUNT, INT16)
        numbers[0x606200] = numbers[0x60FC00] = demand
        numbers[0x606300] = clip_to_integer(physics.angle_rad * self._inc_per_rad - self._motion.shift, INT32)
        numbers[0x606400] = shown
        numbers[0x606B00] = self._compute_speed_demand(true_position)
        numbers[0x606C00] = speed_counts
        numbers[0x607400] = clip_to_integer(
            seen.current_a * self._counts_per_a, INT16
        )  # the current loop leaves no difference
        numbers[0x607700] = numbers[0x607800] = current_counts
        numbers[0x607900] = round(seen.bus * self._bus_mv)
        numbers[0x210100] = voltage_counts
        numbers[0x60F400] = clip_to_integer(demand - true_position, INT32)
        numbers[0x60FD00] = self.inputs
        if self._gauges:
            self._update_vendor_signals(current, voltage, seen.bus * self._bus_mv * 1e-3)
        self.trace.append_row(tick, demand, shown, speed_counts, current_counts, voltage_counts)
        return demand - true_position

    def _update_vendor_signals(self, current_a: float, voltage_v: float, bus_v: float) -> None:
        signals = {
            "current_a": current_a,
            "current_share": current_a * self._counts_per_a * 1e-3,
            "voltage_v": voltage_v,
            "dc_link_v": bus_v,
            "duty": voltage_v / bus_v,
        }
        for gauge in self._gauges:
            self._numbers[gauge.entry.storage_key] = gauge.convert_to_counts(signals[gauge.signal])

    def _compute_speed_demand(self, position: int) -> int:
        """Return the output of the position loop at t_k, increments/s."""
        if self._motion.source is SetpointSource.OFF:
            return 0
        p0, _, f0, _, v0, _, _, _ = self._motion.command
        return clip_to_integer(self._kv * (p0 - position) + self._kff * f0 + v0 * self._inc_per_rad, INT32)

    def update_status_objects(self) -> None:
        word = self._power.state | _VOLTAGE_ENABLED | _REMOTE
        if self._power.powered:
            word |= self._motion.status_bits
            if self._physics.current_limited or self._physics.voltage_limited or self._motion.limited:
                word |= _LIMIT
        if self.inputs & _LIMIT_SWITCHES:
            word |= _LIMIT
        if self.following_error:
            word |= _FOLLOWING_ERROR
        self._numbers[0x604100] = word
        self._numbers[0x606100] = self._motion.mode
