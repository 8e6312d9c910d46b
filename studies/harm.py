"""Assesses whether an accepted model does harm: a parameter beyond its interval, or a path beyond the tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fdhil.config import Axis, Identification
from fdhil.config.axis_section import Nominal
from fdhil.config.regulators import Regulators
from fdhil.model import closed_loop
from fdhil.records import PARAMETERS, Estimate, Float, Parameters, compute_rms
from fdhil.validation.estimate_agreement import LEAST_CHANGE
from studies import drives
from studies.drives import Drive
from studies.scenes import Scene, demand_of

SURE = 3.0  # standard deviations
NEXT_SHARE = 0.3  # of the rapid speed: that of a program that is cut
STEPS_UM = 0.5  # what set-points and positions are rounded to, and less


def make_axis(scene: Scene) -> Axis:
    """Return the section of a machine with this drive and its regulators."""
    d, move = scene.drive, scene.move
    gains = d.vector()
    return Axis(
        screw_pitch_mm=1e3 * d.pitch_m,
        rapid_speed_mm_s=1e3 * move.speed,
        max_acceleration_mm_s2=1e3 * move.acceleration,
        nominal=Nominal(**d.truth()),
        regulators=Regulators(
            position_gain_per_s=d.position_gain,
            speed_feedforward=d.feedforward,
            speed_kp=gains[9],
            speed_ki=gains[10],
            current_limit_a=d.current_limit,
            current_kp=gains[12],
            current_ki=gains[13],
            voltage_limit_v=d.voltage_limit,
        ),
    )


def find_deviating_parameters(estimate: Estimate, drive: Drive) -> list[str]:
    """Return the parameters that deviate from the drive's by more than their intervals, and by enough to matter."""
    found = []
    for name in PARAMETERS:
        value, std, true = estimate.get_value(name), estimate.get_std(name), drive.truth()[name]
        if abs(value - true) > max(SURE * std, LEAST_CHANGE[name] * true):
            found.append(f"{name} {value / true - 1.0:+.1%}, {abs(value - true) / std:.0f} deviations")
    return found


def measure_path_error_um(models: Sequence[Parameters], scene: Scene) -> list[str]:
    """Return the distance of the true machine's table from the prediction, at the rapid and when cutting.

    The tolerance is that of the rapid, in micrometres.
    """
    found: list[str] = []
    axis, limit = make_axis(scene), 0.0
    for share in (1.0, NEXT_SHARE):
        move = replace(scene.move, speed=share * scene.move.speed, distance=share * scene.move.distance)
        there = move.direction * drives.compute_path_speeds(move)
        demand = demand_of(scene, there, -there)
        true = drives.simulate_loop(scene.drive, demand, drives.CYCLE_S)
        for model in models:
            missed, following = _compute_missed_torque(model, axis, 1e3 * demand, 1e3 * true.position)
            limit = limit or max(Identification().compute_tolerance_um(following), STEPS_UM)
            if missed > limit:
                found.append(f"{missed:.2g} um of {following:.3g} um beside the path at {share:.0%} of the speed")
    return found


def _compute_missed_torque(model: Parameters, axis: Axis, demand_mm: Float, position_mm: Float) -> tuple[float, float]:
    reported = closed_loop.simulate_axis(model, axis, drives.CYCLE_S, demand_mm).position_mm
    return 1e3 * compute_rms(position_mm - reported), 1e3 * compute_rms(position_mm - demand_mm)
