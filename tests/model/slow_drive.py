"""An independent drive for the tests: plain Python, Runge-Kutta physics, quantised encoder and set-points.

It shares no code with the model: other integration, other order of work, positions in drive increments.
"""

from __future__ import annotations

import math

from fdhil.config import Axis
from fdhil.records import Parameters

SUBSTEPS = 2


class SlowDrive:
    """One axis with its three loops; ``run`` gives the table's position at each SYNC."""

    def __init__(self, parameters: Parameters, axis: Axis, period_s: float, increments: int = 65536) -> None:
        self.p, self.g, self.period = parameters, axis.regulators, period_s
        self.pitch, self.increments = axis.screw_pitch_mm, increments
        self.i = self.w = self.theta = 0.0
        self.speed_sum = self.current_sum = 0.0

    def _slopes(self, i: float, w: float, u: float, friction: float) -> tuple[float, float, float]:
        p = self.p
        return (u - p.R * i - p.K * w) / p.L, (p.K * i - p.ft * w - friction) / p.Jt, w

    def _integrate(self, u: float, h: float) -> None:
        p = self.p
        if self.w == 0.0 and abs(p.K * self.i) <= p.Cd:
            self.i += (u / p.R - self.i) * (1 - math.exp(-p.R * h / p.L))
            return
        sign = math.copysign(1.0, self.w if self.w != 0.0 else self.i)
        x = (self.i, self.w, self.theta)
        for _ in range(SUBSTEPS):
            d = h / SUBSTEPS
            k1 = self._slopes(x[0], x[1], u, sign * p.Cd)
            k2 = self._slopes(x[0] + d / 2 * k1[0], x[1] + d / 2 * k1[1], u, sign * p.Cd)
            k3 = self._slopes(x[0] + d / 2 * k2[0], x[1] + d / 2 * k2[1], u, sign * p.Cd)
            k4 = self._slopes(x[0] + d * k3[0], x[1] + d * k3[1], u, sign * p.Cd)
            x = (
                x[0] + d / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0]),
                x[1] + d / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1]),
                x[2] + d / 6 * (k1[2] + 2 * k2[2] + 2 * k3[2] + k4[2]),
            )
        self.i, self.w, self.theta = x[0], (x[1] if x[1] * sign > 0 else 0.0), x[2]

    def run(self, demand_mm: list[float]) -> list[float]:
        """Follow ``demand_mm`` (n,) from rest at its first row; return the positions (n,) in mm."""
        per_mm = self.increments / self.pitch
        targets = [round(mm * per_mm) for mm in demand_mm]
        start = demand_mm[0]
        self.theta = 0.0
        n_speed = round(self.period / self.g.speed_period_s)
        n_current = round(self.g.speed_period_s / self.g.current_period_s)
        positions = []
        for k in range(len(targets)):
            positions.append(start + self.theta * self.pitch / (2 * math.pi))
            r0, r1, r2 = (targets[min(k + j, len(targets) - 1)] for j in range(3))
            for m in range(n_speed):
                share = m / n_speed
                encoder = round((start + self.theta * self.pitch / (2 * math.pi)) * per_mm)
                lag = r0 + (r1 - r0) * share - encoder
                slope = ((r1 - r0) + (r2 - 2 * r1 + r0) * share) / self.period
                demand = (self.g.position_gain_per_s * lag + self.g.speed_feedforward * slope) / per_mm
                self._speed_cycle(demand * 2 * math.pi / self.pitch, n_current)
        return positions

    def _speed_cycle(self, demand_rad_s: float, n_current: int) -> None:
        g = self.g
        error = demand_rad_s - self.w
        candidate = self.speed_sum + g.speed_ki * g.speed_period_s * error
        wanted = g.speed_kp * error + candidate
        amps = max(-g.current_limit_a, min(g.current_limit_a, wanted))
        if amps == wanted:
            self.speed_sum = candidate
        for _ in range(n_current):
            error = amps - self.i
            candidate = self.current_sum + g.current_ki * g.current_period_s * error
            wanted = g.current_kp * error + candidate
            volts = max(-g.voltage_limit_v, min(g.voltage_limit_v, wanted))
            if volts == wanted:
                self.current_sum = candidate
            self._integrate(volts, g.current_period_s)
