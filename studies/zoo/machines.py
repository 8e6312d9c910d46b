"""Machines drawn about what practice has, each with two axes, and what an engineer would configure of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from studies.zoo.nc import make_move, make_set_points
from studies.zoo.plant import STEP_S, Array, Drive, Plant

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Reports:
    """How a drive reports: which voltage and current, their scale, noise as a share of the largest value.

    ``ahead`` is by how many cycles the recorded demand is earlier than the set-point that the drive follows.
    """

    voltage: str = "asked_mean"
    current: str = "current"
    scale: float = 1.0  # of current and voltage: sqrt(2/3) reports the peak of a phase
    noise: float = 0.002
    ahead: int = 0
    sampling: str = "interval_mean"


@dataclass(frozen=True, slots=True)
class Rapids:
    """What the NC does: m, m/s, m/s2, m/s3; lengths and shares of the rapid speed of the recorded moves."""

    speed: float = 0.4
    acceleration: float = 4.0
    jerk: float = 150.0
    lengths: tuple[float, ...] = (0.2, 0.2, 0.14)
    shares: tuple[float, ...] = (1.0, 0.7, 1.0)
    feed: float = 0.083

    def train(self, period_s: float) -> Array:
        """Return the set-points (m) of the recorded moves, each back and forth."""
        return self._back_and_forth(self.lengths, self.shares, period_s)

    def held_out(self, period_s: float) -> Array:
        """Return the set-points (m) of moves that no model is identified on: other lengths and speeds, slow ones."""
        return self._back_and_forth((0.6 * self.lengths[0], 0.02, 0.3 * self.lengths[0]), (0.85, 0.05, 0.3), period_s)

    def _back_and_forth(self, lengths: tuple[float, ...], shares: tuple[float, ...], period_s: float) -> Array:
        moves = [
            make_move(sign * length, share * self.speed, self.acceleration, self.jerk, period_s)
            for length, share in zip(lengths, shares, strict=True)
            for sign in (1, -1)
        ]
        return make_set_points(moves, 0.3, period_s)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of machine: its plant and drive before they are drawn, what it reports, how it moves.

    ``drive`` changes the regulators that a motor engineer would set; ``told`` are keys of the drive's parameter list
    that the configuration has besides the gains.
    """

    name: str
    plant: Plant
    drive: Mapping[str, float] = field(default_factory=dict)
    reports: Reports = field(default_factory=Reports)
    rapids: Rapids = field(default_factory=Rapids)
    period_s: float = 1e-3
    speed_hz: float = 40.0
    position_gain: float = 40.0
    told: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis of a drawn machine, and its section in the configuration."""

    kind: Kind
    plant: Plant
    drive: Drive
    section: dict[str, Any]

    def truth(self) -> dict[str, float]:
        """Return the six as the reported signals have them."""
        scale = self.kind.reports.scale
        true = self.plant.truth()
        return true | {"K": true["K"] / scale}


SCREW = Plant(
    R=0.8, L=0.006, K=0.9, Jt=0.010, ft=0.012, Cd=1.2, static=0.15, asymmetry=0.04, bristle_um=3.0, ripple=0.03,
    cogging_nm=0.1, resonance_hz=220.0,
)  # fmt: skip

KINDS = (
    Kind("ordinary screw", SCREW, {"dead_time_v": 0.1}),
    Kind("vertical, weight 5.8 Cd", SCREW._replace(Cd=0.8, gravity_nm=4.64), {"dead_time_v": 0.1}),
    Kind(
        "linear motor",
        Plant(R=1.5, L=0.008, K=1.1, Jt=0.0012, ft=0.004, Cd=0.12, pitch_m=0.03, static=0.1, bristle_um=4.0,
              cogging_nm=0.08, cogging_order=6.0, resonance_hz=450.0, table_share=0.9),
        {"encoder_counts": 300000.0},
        rapids=Rapids(1.0, 10.0, 500.0, (0.4, 0.4, 0.25), feed=0.25),
        speed_hz=70.0, position_gain=80.0,
    ),
    Kind(
        "belt",
        Plant(R=0.6, L=0.003, K=0.5, Jt=0.004, ft=0.006, Cd=0.5, pitch_m=0.075, static=0.1, bristle_um=10.0,
              resonance_hz=55.0, table_share=0.6, damping=0.05),
        rapids=Rapids(1.2, 5.0, 80.0, (0.8, 0.8, 0.5), feed=0.12),
        speed_hz=15.0, position_gain=15.0,
    ),
    Kind(
        "heavy gantry, warming",
        Plant(R=0.3, L=0.005, K=1.4, Jt=0.09, ft=0.08, Cd=6.0, pitch_m=0.02, static=0.2, asymmetry=-0.08,
              bristle_um=4.0, resonance_hz=70.0, table_share=0.7, warming=0.06, ripple=0.05),
        {"voltage_limit": 350.0},
        rapids=Rapids(0.5, 2.0, 30.0, (0.4, 0.4, 0.3)),
        speed_hz=20.0, position_gain=25.0,
    ),
    Kind(
        "brushed motor, PID, 8000 counts",
        Plant(R=0.7, L=0.002, K=0.35, Jt=0.0015, ft=0.002, Cd=0.35, pitch_m=0.01, static=0.2, bristle_um=3.0),
        {"brushed": 1.0, "structure": 1.0, "encoder_counts": 8000.0, "dead_time_v": 0.4, "voltage_limit": 120.0,
         "speed_steps": 16.0, "current_steps": 8.0},
        Reports(voltage="terminal_mean"),
        Rapids(0.25, 2.0, 0.0, (0.15, 0.15, 0.1), feed=0.05),
        position_gain=30.0,
    ),
    Kind("short rapids", SCREW, rapids=Rapids(lengths=(0.04, 0.025, 0.012), shares=(1.0, 1.0, 1.0))),
    Kind("override 30-50 %", SCREW, rapids=Rapids(shares=(0.5, 0.3, 0.4))),
    Kind("4 ms SYNC, stepping feed-forward", SCREW, {"stepping": 1.0}, period_s=4e-3, position_gain=25.0),
    Kind("2 ms SYNC, stepping feed-forward", SCREW, {"stepping": 1.0}, period_s=2e-3),
    Kind("machine bed 18 Hz", SCREW._replace(bed_hz=18.0, bed_ratio=12.0)),
    Kind("NC trace, 4 cycles ahead", SCREW, reports=Reports(ahead=4), period_s=2e-3),
    Kind("phase-peak current and voltage", SCREW, reports=Reports(scale=math.sqrt(2 / 3))),
    Kind("presliding over 20 um", SCREW._replace(bristle_um=20.0, static=0.3, Cd=2.0)),
    Kind("play 8 um, speed filter not told",
         SCREW._replace(backlash_rad=8e-6 / 0.01 * 2 * math.pi), {"speed_filter_s": 1e-3}),
    Kind("dead time 0.5 V, sag 5 %, d and q coupled", SCREW,
         {"dead_time_v": 0.5, "sag": 0.05, "decoupling": 0.0, "torque_filter_s": 3e-4,
         "late_voltage": 1.0, "inertia_feedforward": 0.9},
         told=("torque_feedforward", "current_delay_cycles")),
    Kind("1 ms SYNC, stepping feed-forward", SCREW, {"stepping": 1.0}),
)  # fmt: skip


SHEET_WIDTHS = {"R": 0.05, "L": 0.05, "K": 0.01, "Jt": 0.1, "ft": 0.3, "Cd": 0.3}
"""Shares by which a data sheet is off at most."""


def draw(kind: Kind, rng: Rng) -> Axis:
    """Draw one axis: sizes within 15 %, shares within 30 %, a data sheet that is off as data sheets are."""
    near: Callable[[float], float] = lambda width: float(rng.uniform(1 - width, 1 + width))  # noqa: E731
    p = kind.plant
    sizes = {name: getattr(p, name) * near(0.15) for name in ("R", "L", "K", "Jt", "ft", "Cd", "resonance_hz")}
    shares = ("static", "asymmetry", "bristle_um", "ripple", "cogging_nm", "gravity_nm", "warming", "backlash_rad")
    plant = p._replace(**sizes, **{name: getattr(p, name) * near(0.3) for name in shares})
    if p.gravity_nm:
        plant = plant._replace(gravity_nm=p.gravity_nm / p.Cd * plant.Cd)
    sheet = {name: getattr(plant, name) * near(width) for name, width in SHEET_WIDTHS.items()}
    drive = _regulators(kind, sheet)
    rapids, scale = kind.rapids, kind.reports.scale
    seen = sheet | {"K": sheet["K"] / scale}
    regulators = {
        "structure": "pid" if drive.structure else "p_pi_pi",
        "position_gain_per_s": drive.position_gain,
        "speed_feedforward": drive.feedforward,
        "speed_kp": drive.speed_kp * scale,
        "speed_ki": 0.0 if drive.structure else drive.speed_ki * scale,
        "speed_period_s": drive.speed_steps * STEP_S,
        "current_limit_a": drive.current_limit * scale,
        "current_kp": drive.current_kp,
        "current_ki": drive.current_ki,
        "current_period_s": drive.current_steps * STEP_S,
        "voltage_limit_v": drive.voltage_limit * scale,
    }
    if drive.structure:
        regulators["position_ki_per_s2"] = drive.position_ki
    known = {
        "torque_feedforward": drive.inertia_feedforward * plant.Jt / plant.K / (sheet["Jt"] / sheet["K"]),
        "current_delay_cycles": int(drive.late_voltage),
    }
    regulators |= {key: known[key] for key in kind.told}
    section = {
        "screw_pitch_mm": 1e3 * plant.pitch_m,
        "rapid_speed_mm_s": 1e3 * rapids.speed,
        "max_acceleration_mm_s2": 1e3 * rapids.acceleration,
        "nominal": seen,
        "regulators": regulators,
        "correction": {"max_offset_um": 250.0, "max_speed_mm_s": 20.0, "max_acceleration_mm_s2": 2000.0},
    }
    return Axis(kind, plant, drive, section)


def _regulators(kind: Kind, sheet: Mapping[str, float]) -> Drive:
    """Return the regulators as they are set by the data sheet."""
    corner = 2 * math.pi * kind.speed_hz
    speed_kp = corner * sheet["Jt"] / sheet["K"]
    voltage = kind.drive.get("voltage_limit", 320.0)
    rapid = kind.rapids
    torque = sheet["Jt"] * rapid.acceleration / kind.plant.pitch_m * 2 * math.pi
    torque += 2 * sheet["Cd"] + sheet["ft"] * rapid.speed / kind.plant.pitch_m * 2 * math.pi
    drive = Drive(
        position_gain=kind.position_gain,
        speed_kp=speed_kp,
        speed_ki=speed_kp * corner / 5,
        current_kp=2 * math.pi * 400 * sheet["L"],
        current_ki=2 * math.pi * 400 * sheet["R"],
        current_limit=2.5 * (torque + kind.plant.gravity_nm) / sheet["K"],
        voltage_limit=voltage,
        position_ki=kind.position_gain * corner / 8,
    )
    return drive._replace(**{key: value for key, value in kind.drive.items() if key != "voltage_limit"})


def machine(kind: Kind, seed: int) -> dict[str, Axis]:
    """Return the axes X and Y of one machine of a kind."""
    number = [each.name for each in KINDS].index(kind.name)
    return {name: draw(kind, np.random.default_rng([seed, number, k])) for k, name in enumerate("XY")}
