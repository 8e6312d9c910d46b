"""Runs a drive's cycles: apply set-points, sample all objects, supervise the following error, integrate the motion."""

from collections.abc import Callable

from fdhil.sim.drive.axis_plant import AxisPlant
from fdhil.sim.drive.drive_objects import DriveRatings
from fdhil.sim.drive.drive_sensors import DriveFaults
from fdhil.sim.drive.feedback import Feedback
from fdhil.sim.drive.motion_objects import NO_WINDOW
from fdhil.sim.drive.object_dictionary import ObjectDictionary
from fdhil.sim.drive.plant_physics import ClosedLoops
from fdhil.sim.drive.power_stage import PowerStage, PowerState
from fdhil.sim.drive.setpoint_selection import SetpointSelector

_CREEP_RAD_S = 1e-6  # slower than this an unpowered axis is at standstill
_NO_LIMIT = 0xFFFF


class DriveCycle:
    """One cycle is :meth:`begin`, then :meth:`integrate`; ``tick`` counts them.

    ``table_mm`` is the true table position at the start of the cycle, in the axis' direction. ``ended`` is called after
    each cycle with the mean voltage of the cycle before it.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        ratings: DriveRatings,
        plant: AxisPlant,
        power: PowerStage,
        motion: SetpointSelector,
        feedback: Feedback,
        faults: DriveFaults,
    ) -> None:
        self._numbers = dictionary.numbers
        self._ratings = ratings
        self._plant = plant
        self._power, self._motion, self._feedback, self._faults = power, motion, feedback, faults
        self._loops = ClosedLoops.POSITION
        self._limits = self._limit_objects
        self.on_cycle_end: Callable[[float], None] | None = None
        self.tick = 0
        self.table_mm = self._true_table_mm
        self.reset_supervision()

    def reset_supervision(self) -> None:
        self._over_window = self._last_offset = 0

    @property
    def is_at_standstill(self) -> bool:
        """Whether nothing can move: no current flows, and the axis is at standstill."""
        return not self._power.powered and abs(self._plant.physics.speed_rad_s) < _CREEP_RAD_S

    def keep_offset(self) -> None:
        """Discard writes to 0x60B0 while the fault ``ignore_offset`` is active."""
        if self._faults.ignore_offset:
            self._numbers[0x60B000] = self._last_offset
        self._last_offset = self._numbers[0x60B000]

    def begin_cycle(self) -> bool:
        """Apply the set-points and sample all objects; return whether the following error is too large."""
        self._motion.begin_cycle(self._feedback.actual)
        tripped = self._is_beyond(self._feedback.sample_objects(self.tick))
        self.table_mm = self._true_table_mm
        return tripped

    def integrate_cycle(self) -> None:
        physics, motion = self._plant.physics, self._motion
        ended_v = physics.voltage_mean_v
        if motion.loops is not self._loops:
            self._loops = motion.loops
            physics.close_loops(motion.loops)
        if self._limit_objects != self._limits:
            self._limits = self._limit_objects
            physics.limit_current(min(self._limits) * 1e-3 * self._ratings.rated_current_a)
        command = motion.command
        if motion.shift:
            command = (command[0] + motion.shift, command[1] + motion.shift, *command[2:])
        physics.load_torque_nm = float(self._faults.load_torque_nm)
        physics.run_cycle(self._power.powered, command)
        self.tick += 1
        if self.on_cycle_end is not None:
            self.on_cycle_end(ended_v)

    @property
    def _true_table_mm(self) -> float:
        place = self._plant.physics.table_rad * self._plant.mm_per_rad
        shift = self._motion.shift
        return place - self._ratings.sign * shift / self._ratings.increments_per_mm if shift else place

    @property
    def _limit_objects(self) -> tuple[int, int]:
        return self._numbers.get(0x607200, _NO_LIMIT), self._numbers.get(0x607300, _NO_LIMIT)

    def _is_beyond(self, error: int) -> bool:
        window = self._numbers[0x606500]
        if window == NO_WINDOW or not self._power.powered or abs(error) <= window:
            self._over_window = 0
            return False
        self._over_window += 1
        over_ms = (self._over_window - 1) * self._ratings.sync_period_s * 1e3
        return over_ms >= self._numbers[0x606600] and self._power.state is not PowerState.FAULT_REACTION_ACTIVE
