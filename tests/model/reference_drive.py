"""An independent reference drive: plain Python, quantised encoder and set-points, two physics implementations.

It shares no code with the model: other integration, other order of computation, positions in drive increments.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from fdhil.config import Axis
from fdhil.records import Float, Parameters

SUBSTEPS = 2


class ReferenceDrive:
    """One axis with its regulators; ``run`` returns the table position at each SYNC. Physics by Runge-Kutta."""

    def __init__(self, parameters: Parameters, axis: Axis, period_s: float, increments: int = 65536) -> None:
        self.p, self.g, self.period = parameters, axis.regulators, period_s
        self.nominal = axis.nominal
        self.pitch, self.increments = axis.screw_pitch_mm, increments
        self.i = self.w = self.theta = 0.0
        self.speed_sum = self.current_sum = self.position_sum = 0.0
        self.start = 0.0
        self.before: tuple[float, float] | None = None
        self.seen = 0.0
        self.commands: list[float] = []
        self.measured = self.error_sum = self.output = 0.0
        self.saturated = 0
        self.pipeline = [0.0] * axis.regulators.current_delay_cycles
        self.memory: list[list[float]] = []

    def _compute_smooth_torque(self, w: float, theta: float, side: float) -> float:
        p, terms = self.p, dict(self.p.terms)
        angle = theta + self.start * 2 * math.pi / self.pitch
        total = p.get_term("load") + w * p.get_term("viscous_positive" if side > 0 else "viscous_negative", p.ft)
        for name, amplitude in terms.items():
            if name.startswith("ripple") and not name.endswith("phase"):
                total += amplitude * math.sin(int(name.split("_")[2]) * angle + terms.get(name + "_phase", 0.0))
        return total

    def _compute_dry_friction(self, w: float, side: float) -> float:
        p = self.p
        dry = p.get_term("coulomb_positive" if side > 0 else "coulomb_negative", p.Cd)
        return dry + (p.get_term("stribeck") * math.exp(-((w / p.get_term("stribeck_speed", 1.0)) ** 2)))

    def _compute_motor_voltage(self, u: float) -> float:
        whole_at = self.g.voltage_limit_v * self.g.current_period_s / (4 * self.nominal.L)
        return u - self.p.get_term("dead_time") * max(-1.0, min(1.0, self.i / whole_at))

    def _compute_derivatives(
        self, i: float, w: float, theta: float, u: float, side: float
    ) -> tuple[float, float, float]:
        p = self.p
        against = self._compute_smooth_torque(w, theta, side) + side * self._compute_dry_friction(w, side)
        return (u - p.R * i - p.K * w) / p.L, (p.K * i - against) / p.Jt, w

    def _is_held(self) -> bool:
        push = self.p.K * self.i - self._compute_smooth_torque(0.0, self.theta, 1.0)
        return self.w == 0.0 and abs(push) <= self._compute_dry_friction(0.0, push)

    def _determine_sign(self) -> float:
        return math.copysign(
            1.0, self.w if self.w != 0.0 else self.p.K * self.i - self._compute_smooth_torque(0.0, self.theta, 1.0)
        )

    def _integrate_step(self, u: float, h: float) -> None:
        p = self.p
        if self._is_held():
            self.i += (u / p.R - self.i) * (1 - math.exp(-p.R * h / p.L))
            return
        sign = self._determine_sign()
        x = (self.i, self.w, self.theta)
        for _ in range(SUBSTEPS):
            d = h / SUBSTEPS
            k1 = self._compute_derivatives(x[0], x[1], x[2], u, sign)
            k2 = self._compute_derivatives(x[0] + d / 2 * k1[0], x[1] + d / 2 * k1[1], x[2] + d / 2 * k1[2], u, sign)
            k3 = self._compute_derivatives(x[0] + d / 2 * k2[0], x[1] + d / 2 * k2[1], x[2] + d / 2 * k2[2], u, sign)
            k4 = self._compute_derivatives(x[0] + d * k3[0], x[1] + d * k3[1], x[2] + d * k3[2], u, sign)
            x = (
                x[0] + d / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0]),
                x[1] + d / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1]),
                x[2] + d / 6 * (k1[2] + 2 * k2[2] + 2 * k3[2] + k4[2]),
            )
        self.i, self.w, self.theta = x[0], (x[1] if x[1] * sign > 0 else 0.0), x[2]

    def follow_demand(self, demand_mm: list[float]) -> list[float]:
        """Follow ``demand_mm`` (n,) from rest at its first sample; return the positions (n,) in mm."""
        per_mm = self.increments / self.pitch
        targets = [round(mm * per_mm) for mm in demand_mm]
        start = self.start = demand_mm[0]
        self.theta = 0.0
        self.memory = [[targets[0], 0.0, 0.0] for _ in range(self.g.setpoint_filter_order)]
        n_speed = round(self.period / self.g.speed_period_s)
        positions = []
        for k in range(len(targets)):
            positions.append(start + self.theta * self.pitch / (2 * math.pi))
            r0, r1, r2 = (targets[min(k + j, len(targets) - 1)] for j in range(3))
            if self.g.structure == "linuxcnc_pid":
                encoder = round((start + self.theta * self.pitch / (2 * math.pi)) * per_mm)
                self._run_linuxcnc_pid(2 * math.pi / self.increments * r0, 2 * math.pi / self.increments * encoder)
            for m in range(n_speed):
                share = m / n_speed
                encoder = round((start + self.theta * self.pitch / (2 * math.pi)) * per_mm)
                slope = ((r1 - r0) + (r2 - 2 * r1 + r0) * share) / self.period
                bend = (r2 - 2 * r1 + r0) / self.period**2
                ordered = self._filter_setpoint([r0 + (r1 - r0) * share, slope, bend])
                self._run_speed_cycle(*(2 * math.pi / self.increments * v for v in (*ordered, encoder)))
        return positions

    def _run_linuxcnc_pid(self, command: float, measured: float) -> None:
        g, t = self.g, self.period
        if not self.commands:
            self.commands, self.measured = [command] * 4, measured
        self.commands = [command, *self.commands[:3]]
        r = self.commands
        dead = g.deadband_mm * 2 * math.pi / self.pitch
        error = r[1 if g.error_previous_target else 0] - measured
        error = math.copysign(max(0.0, abs(error) - dead), error)
        if error * self.saturated <= 0:
            self.error_sum += error * t
        slopes = [(a - b) / t for a, b in pairwise(r)]
        bends = [(a - b) / t for a, b in pairwise(slopes)]
        jerk = (bends[0] - bends[1]) / t
        closing = slopes[0] - (measured - self.measured) / t
        self.measured = measured
        wanted = g.position_gain_per_s * error + g.position_ki_per_s2 * self.error_sum
        wanted += g.position_derivative * closing + g.position_feedforward_per_s * command
        wanted += g.speed_feedforward * slopes[0] + g.acceleration_feedforward_s * bends[0]
        wanted += g.jerk_feedforward_s2 * jerk
        most = g.output_limit_mm_s * 2 * math.pi / self.pitch or math.inf
        self.output = max(-most, min(most, wanted))
        self.saturated = (wanted > most) - (wanted < -most)

    def _filter_setpoint(self, signals: list[float]) -> list[float]:
        if self.g.setpoint_filter_s > 0:
            for stage in self.memory:
                for n, value in enumerate(signals):
                    stage[n] += -math.expm1(-self.g.speed_period_s / self.g.setpoint_filter_s) * (value - stage[n])
                signals = list(stage)
        return signals

    def _filter_speed(self, speed: float) -> float:
        if self.g.speed_filter_s > 0:
            self.seen += -math.expm1(-self.g.speed_period_s / self.g.speed_filter_s) * (speed - self.seen)
            return self.seen
        return speed

    def _run_speed_cycle(self, place: float, rate: float, acceleration: float, encoder: float) -> None:
        g, h = self.g, self.g.speed_period_s
        lag = place - encoder
        position_sum = self.position_sum + g.position_ki_per_s2 * h * lag
        outer = g.position_gain_per_s * lag + position_sum
        speed_sum = self.speed_sum
        if g.structure == "pid":
            before = self.before or (place, encoder)
            difference = g.speed_feedforward * (place - before[0]) - h * self._filter_speed((encoder - before[1]) / h)
            self.before = place, encoder
            wanted = g.speed_kp * (outer + difference / h)
        elif g.structure == "linuxcnc_pid":
            position_sum, wanted = self.position_sum, g.speed_kp * self.output
            if g.pid_output == "speed":
                error = self.output - self._filter_speed(self.w)
                speed_sum += g.speed_ki * h * error
                wanted = g.speed_kp * error + speed_sum
        else:
            error = outer + g.speed_feedforward * rate - self._filter_speed(self.w)
            speed_sum += g.speed_ki * h * error
            wanted = g.speed_kp * error + speed_sum
        wanted += g.torque_feedforward * acceleration * self.nominal.Jt / self.nominal.K
        amps = max(-g.current_limit_a, min(g.current_limit_a, wanted))
        if amps == wanted:
            self.speed_sum, self.position_sum = speed_sum, position_sum
        for _ in range(round(h / g.current_period_s)):
            self._run_current_cycle(amps)

    def _run_current_cycle(self, amps: float) -> None:
        g = self.g
        error = amps - self.i
        candidate = self.current_sum + g.current_ki * g.current_period_s * error
        wanted = g.current_kp * error + candidate
        volts = max(-g.voltage_limit_v, min(g.voltage_limit_v, wanted))
        if volts == wanted:
            self.current_sum = candidate
        self.pipeline.append(volts)
        self._integrate_step(self._compute_motor_voltage(self.pipeline.pop(0)), g.current_period_s)


class EventReferenceDrive(ReferenceDrive):
    """The same regulators around equations [1] and [2], solved by ``solve_ivp`` with standstill as an event."""

    def _integrate_step(self, u: float, h: float) -> None:
        p = self.p
        if self._is_held():
            super()._integrate_step(u, h)
            return
        sign = self._determine_sign()

        def compute_derivatives(_t: float, x: Float) -> tuple[float, float, float]:
            return self._compute_derivatives(x[0], x[1], x[2], u, sign)

        def detect_standstill(_t: float, x: Float) -> float:
            return float(x[1])

        detect_standstill.terminal = True  # type: ignore[attr-defined]  # scipy's own way to mark an event
        detect_standstill.direction = -sign  # type: ignore[attr-defined]
        solution = solve_ivp(
            compute_derivatives, (0.0, h), (self.i, self.w, self.theta), events=detect_standstill, rtol=1e-7, atol=1e-10
        )
        self.i, self.w, self.theta = np.asarray(solution.y[:, -1]).tolist()
        if solution.status == 1:
            left = h - float(solution.t[-1])
            self.w = 0.0
            self.i += (u / p.R - self.i) * (1 - math.exp(-p.R * left / p.L))


class TwoMassReferenceDrive(ReferenceDrive):
    """The same regulators around a motor that drives its table through a spring; dry friction acts on the table."""

    def __init__(self, parameters: Parameters, axis: Axis, period_s: float, increments: int = 65536) -> None:
        super().__init__(parameters, axis, period_s, increments)
        p, self.share = parameters, parameters.get_term("resonance_share", 0.5)
        reduced = p.Jt * self.share * (1 - self.share)
        self.stiffness = reduced * (2 * math.pi * p.get_term("resonance")) ** 2
        self.damping = 2 * p.get_term("resonance_damping") * math.sqrt(self.stiffness * reduced)
        self.table = self.table_w = 0.0
        self.tables_mm: list[float] = []

    def _compute_spring_torque(self, x: Float) -> float:
        return float(self.stiffness * (x[2] - x[4]) + self.damping * (x[1] - x[3]))

    def _compute_two_mass_derivatives(self, x: Float, u: float, side: float) -> Float:
        p, pull = self.p, self._compute_spring_torque(x)
        motor = p.K * x[0] - self._compute_smooth_torque(x[1], x[2], math.copysign(1.0, x[1])) - pull
        table = 0.0 if side == 0.0 else pull - side * self._compute_dry_friction(x[3], side)
        slopes = [(u - p.R * x[0] - p.K * x[1]) / p.L, motor / (p.Jt * (1 - self.share)), x[1]]
        return np.array([*slopes, table / (p.Jt * self.share), x[3]])

    def _integrate_step(self, u: float, h: float) -> None:
        x, d = np.array([self.i, self.w, self.theta, self.table_w, self.table]), h / SUBSTEPS
        for _ in range(SUBSTEPS):
            side = math.copysign(1.0, x[3] if x[3] != 0.0 else self._compute_spring_torque(x))
            if x[3] == 0.0 and abs(self._compute_spring_torque(x)) <= self._compute_dry_friction(0.0, side):
                side = 0.0
            k1 = self._compute_two_mass_derivatives(x, u, side)
            k2 = self._compute_two_mass_derivatives(x + d / 2 * k1, u, side)
            k3 = self._compute_two_mass_derivatives(x + d / 2 * k2, u, side)
            x = x + d / 6 * (k1 + 2 * k2 + 2 * k3 + self._compute_two_mass_derivatives(x + d * k3, u, side))
            x[3] = 0.0 if x[3] * side < 0 else x[3]
        self.i, self.w, self.theta, self.table_w, self.table = x.tolist()

    def _run_speed_cycle(self, place: float, rate: float, acceleration: float, encoder: float) -> None:
        self.tables_mm.append(self.start + self.table * self.pitch / (2 * math.pi))
        super()._run_speed_cycle(place, rate, acceleration, encoder)
