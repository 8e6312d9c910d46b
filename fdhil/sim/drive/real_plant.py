"""Models one axis with the effects of real machines: friction, load, ripples, compliance, inverter, encoder, loops.

It replaces :class:`fdhil.sim.drive.plant_physics.PlantPhysics` where ``[sim.axis.X.reality]`` names an effect, or the
regulators have a filter or a delay. All quantities are in the drive's own direction.
"""

import math

import numpy as np

from fdhil.config import Reality, Regulators
from fdhil.records import Float, Parameters
from fdhil.sim.drive import real_plant_kernels as cycle
from fdhil.sim.drive.plant_physics import (
    CURRENT_LIMIT,
    VOLTAGE_LIMIT,
    ClosedLoops,
    Command,
    PlantPhysics,
    SensedState,
    select_gains,
)

BRISTLE_DAMPING = 1.0  # half of the bristles' critical damping: they ring once


def apply_real_loops(reality: Reality, regulators: Regulators) -> Regulators:
    """Return the regulators with the deviations of the real drive."""
    return regulators.model_copy(update=reality.list_loop_settings())


def is_plain(reality: Reality, regulators: Regulators) -> bool:
    """Whether the paper's plant and loops suffice."""
    return reality == Reality() and not (
        regulators.speed_filter_s or regulators.setpoint_filter_s or regulators.current_delay_cycles
    )


class RealPlantPhysics(PlantPhysics):
    """One axis' mechanics and loops; ``rad_per_mm`` has the sign of the drive's direction relative to the axis."""

    def __init__(
        self,
        parameters: Parameters,
        regulators: Regulators,
        sync_period_s: float,
        increments_per_rev: int,
        reality: Reality,
        *,
        rad_per_mm: float,
        angle_rad: float = 0.0,
        backlash_rad: float = 0.0,
    ) -> None:
        self._reality = reality
        self._regulators = apply_real_loops(reality, regulators)
        self._rad_per_mm = rad_per_mm
        self._backlash_rad = backlash_rad
        self._period_s = sync_period_s
        self._x = np.zeros(cycle.STATES)
        self._x[[cycle.ANGLE, cycle.TABLE]] = angle_rad
        self._x[cycle.BUS] = 1.0
        self._g = self._pack_loops(sync_period_s, increments_per_rev)
        self._real_gains = self._g[: cycle.KIS + 1].copy()
        self._was_enabled = False
        self._encoder_rad: float | None = None
        self._shown_speed = 0.0
        self.command_mean_v = 0.0
        super().__init__(parameters, regulators, sync_period_s, increments_per_rev)
        self._reset_loops()

    def set_parameters(self, parameters: Parameters) -> None:
        """Change the plant from the next cycle on; the added effects keep their proportion."""
        self.parameters = parameters
        self._p = self._pack_plant(parameters)

    def close_loops(self, loops: ClosedLoops) -> None:
        self._g[: cycle.KIS + 1] = select_gains(self._real_gains, loops)
        self._x[cycle.SPEED_INTEGRAL] = 0.0 if loops is ClosedLoops.CURRENT else self._x[cycle.CURRENT]

    def limit_current(self, limit_a: float) -> None:
        self._g[cycle.I_MAX] = min(limit_a, self._regulators.current_limit_a)

    @property
    def table_speed_rad_s(self) -> float:
        p, angle = self._p, float(self._x[cycle.TABLE])
        return float(self._x[cycle.TABLE_SPEED] * (1.0 + p[cycle.PITCH] * math.cos(angle) + p[cycle.PITCH_RATE]))

    def compile_kernels(self) -> None:
        self._call_real_kernel(self._x.copy(), self.voltage_v.copy(), False, (0.0,) * 8)

    def run_cycle(self, enabled: bool, command: Command) -> None:
        """Run one SYNC cycle; ``enabled`` False means that no current flows and the brake is closed."""
        if enabled and not self._was_enabled:
            self._x[[cycle.PLACE, cycle.PLACE_2]] = command[0]  # a filter starts at the set-point
        if not enabled:
            self._reset_loops()
        self._was_enabled = enabled
        self.voltage_mean_v, self.command_mean_v, limits = self._call_real_kernel(
            self._x, self.voltage_v, enabled, command
        )
        self.current_limited = limits & CURRENT_LIMIT != 0
        self.voltage_limited = limits & VOLTAGE_LIMIT != 0
        self._unpack_state()

    def _call_real_kernel(self, x: Float, voltage: Float, enabled: bool, command: Command) -> tuple[float, float, int]:
        load = self.load_torque_nm + math.copysign(1.0, self._rad_per_mm) * self._reality.load_nm
        return cycle.simulate_real_cycle(x, self._g, self._p, voltage, enabled, command, load, self.step_s)

    def _reset_loops(self) -> None:
        x = self._x
        x[[cycle.SPEED_INTEGRAL, cycle.CURRENT_INTEGRAL, cycle.RATE, cycle.RATE_2]] = 0.0
        x[cycle.WAITING :] = 0.0
        x[cycle.SEEN_SPEED] = x[cycle.SPEED]
        x[cycle.ENCODER] = cycle.compute_encoder_angle(self._p, self._g, x, False)
        self._was_enabled = False

    def _unpack_state(self) -> None:
        x = self._x
        self.current_a, self.speed_rad_s, self.angle_rad = x[: cycle.TABLE_SPEED].tolist()
        self.table_rad = cycle.compute_table_angle(self._p, x)
        reality = self._reality
        motor = cycle.compute_encoder_angle(self._p, self._g, x, False)
        position = cycle.compute_encoder_angle(self._p, self._g, x, reality.position_encoder == "table")
        voltage = self.voltage_mean_v if reality.voltage_object == "terminals" else self.command_mean_v
        self.sensed = SensedState(
            position,
            self._compute_sensed_speed(motor),
            reality.current_gain * self.current_a + reality.current_offset_a,
            reality.voltage_gain * voltage,
            float(x[cycle.BUS]),
        )

    def _compute_sensed_speed(self, encoder_rad: float) -> float:
        """Return the speed reported as 0x606C; to be called once per SYNC."""
        reality = self._reality
        speed = self.speed_rad_s
        if reality.speed_object == "loop":
            speed = float(self._x[cycle.SEEN_SPEED])
        elif reality.speed_object == "difference":
            speed = 0.0 if self._encoder_rad is None else (encoder_rad - self._encoder_rad) / self._period_s
        self._encoder_rad = encoder_rad
        if reality.speed_object_filter_s:
            self._shown_speed += (1.0 - math.exp(-self._period_s / reality.speed_object_filter_s)) * (
                speed - self._shown_speed
            )
            return self._shown_speed
        return speed

    def _pack_loops(self, sync_period_s: float, increments_per_rev: int) -> Float:
        g, reality = self._regulators, self._reality
        turn = 2 * math.pi
        values = np.zeros(cycle.LOOPS)
        values[cycle.KV], values[cycle.KFF] = g.position_gain_per_s, g.speed_feedforward
        values[cycle.KPS], values[cycle.KIS] = g.speed_kp, g.speed_ki * g.speed_period_s
        values[cycle.KPC], values[cycle.KIC] = g.current_kp, g.current_ki * g.current_period_s
        values[cycle.I_MAX], values[cycle.U_MAX] = g.current_limit_a, g.voltage_limit_v
        values[cycle.INC_PER_RAD] = increments_per_rev / turn
        values[cycle.N_SPEED] = round(sync_period_s / g.speed_period_s)
        values[cycle.N_CURRENT] = round(g.speed_period_s / g.current_period_s)
        values[cycle.FILTER_PART] = _compute_lag_share(g.speed_period_s, g.setpoint_filter_s)
        values[cycle.FILTER_ORDER] = g.setpoint_filter_order if g.setpoint_filter_s else 0
        values[cycle.SPEED_PART] = _compute_lag_share(g.speed_period_s, g.speed_filter_s)
        values[cycle.DELAY] = g.current_delay_cycles
        values[cycle.ENCODER_STEP] = turn / 2**reality.encoder_bits if reality.encoder_bits else 0.0
        values[cycle.ON_TABLE] = reality.position_encoder == "table"
        values[cycle.OF_ENCODER] = 1 / g.speed_period_s if reality.speed_feedback == "difference" else 0.0
        values[cycle.CURRENT_GAIN], values[cycle.CURRENT_OFFSET] = reality.current_gain, reality.current_offset_a
        return values

    def _pack_plant(self, parameters: Parameters) -> Float:
        reality, values = self._reality, np.zeros(cycle.PLANT)
        direction = math.copysign(1.0, self._rad_per_mm)
        values[cycle.R], values[cycle.L], values[cycle.K] = parameters.R, parameters.L, parameters.K
        self._pack_masses(parameters, values)
        values[cycle.STATIC], values[cycle.STATIC_SPEED] = reality.static_friction, reality.static_speed_rad_s
        values[cycle.ASYMMETRY] = direction * reality.friction_asymmetry
        values[cycle.VISCOUS_ASYMMETRY] = direction * reality.viscous_asymmetry
        values[cycle.WAVE], values[cycle.SIGN] = reality.friction_ripple, direction
        if reality.presliding_um:  # the bristles' stiffness, per N.m of dry friction
            displacement_rad = abs(self._rad_per_mm) * reality.presliding_um * 1e-3
            values[cycle.BRISTLES] = (1 + reality.static_friction) / displacement_rad
            values[cycle.BRISTLE_DAMPING] = BRISTLE_DAMPING
        values[cycle.BRAKE] = reality.brake_nm
        values[cycle.SCREW], values[cycle.SCREW_ORDER] = reality.screw_ripple_nm, reality.screw_ripple_order
        values[cycle.SCREW_PHASE] = direction * reality.screw_ripple_phase_rad
        values[cycle.MOTOR], values[cycle.MOTOR_ORDER] = reality.motor_ripple_nm, reality.motor_ripple_order
        values[cycle.MOTOR_PHASE] = direction * reality.motor_ripple_phase_rad
        values[cycle.HALF_BACKLASH] = self._backlash_rad / 2
        values[cycle.DEAD], values[cycle.DEAD_CURRENT] = reality.dead_time_v, reality.dead_time_current_a
        values[cycle.SAG] = reality.bus_sag / (reality.bus_power_kw * 1e3)
        values[cycle.BUS_PART] = _compute_lag_share(self._regulators.current_period_s, reality.bus_time_constant_s)
        values[cycle.PITCH] = abs(self._rad_per_mm) * reality.pitch_error_um * 1e-3
        values[cycle.PITCH_RATE] = reality.pitch_error_um_per_m * 1e-6
        return values

    def _pack_masses(self, parameters: Parameters, values: Float) -> None:
        """Distribute inertia and friction between motor and table, and set the spring between them."""
        reality = self._reality
        if not reality.resonance_hz:
            values[cycle.JM], values[cycle.FM], values[cycle.CM] = parameters.Jt, parameters.ft, parameters.Cd
            return
        behind, rubs = reality.table_inertia, reality.table_friction
        values[cycle.JM], values[cycle.JT] = (1 - behind) * parameters.Jt, behind * parameters.Jt
        values[cycle.FM], values[cycle.FT] = (1 - rubs) * parameters.ft, rubs * parameters.ft
        values[cycle.CM], values[cycle.CT] = (1 - rubs) * parameters.Cd, rubs * parameters.Cd
        reduced = behind * (1 - behind) * parameters.Jt  # both masses oscillate against each other
        swing = 2 * math.pi * reality.resonance_hz
        values[cycle.STIFFNESS] = swing**2 * reduced
        values[cycle.DAMPER] = 2 * reality.resonance_damping * swing * reduced


def _compute_lag_share(step_s: float, time_constant_s: float) -> float:
    """Return the step response of a first-order lag after one step; 1 without a time constant."""
    return 1.0 - math.exp(-step_s / time_constant_s) if time_constant_s else 1.0
