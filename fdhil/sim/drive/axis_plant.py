"""Holds the axis' mechanics and loops; its parameters follow commands and temperature."""

import math
from dataclasses import replace

from fdhil.config import MachineConfig, Noise, SimAxis
from fdhil.records import PARAMETERS, Parameters
from fdhil.sim.drive.drive_objects import DriveRatings
from fdhil.sim.drive.homing import Switches
from fdhil.sim.drive.plant_physics import PlantPhysics, build_plant_parameters
from fdhil.sim.drive.real_plant import RealPlantPhysics, is_plain


class AxisPlant:
    """The plant of one axis. ``mm_per_rad`` has the sign of the drive's direction; ``celsius`` is the slide-way's."""

    def __init__(self, config: MachineConfig, axis: str, sim_axis: SimAxis) -> None:
        section = config.axis[axis]
        self.mm_per_rad = section.drive.sign * section.screw_pitch_mm / (2 * math.pi)
        self._reference_c = self.celsius = config.sim.thermal.ambient_c
        self._per_kelvin = (sim_axis.ft_per_kelvin, sim_axis.Cd_per_kelvin)
        self._parameters = build_plant_parameters(section.nominal, sim_axis)
        self.physics = _create_physics(self._parameters, config, axis, sim_axis, 1 / self.mm_per_rad)

    def set_parameters(self, **values: float) -> None:
        """Change parameters at the reference temperature from the next cycle on; TypeError, ValueError if invalid."""
        unknown = [name for name in values if name not in PARAMETERS]
        if unknown:
            raise TypeError(f"{', '.join(unknown)}: not a parameter of a drive")
        changed = self._parameters.replace_values(**values)
        for name, value in changed.as_dict().items():
            if not (math.isfinite(value) and value >= 0 and (value > 0 or name in ("ft", "Cd"))):
                raise ValueError(f"{name} = {value} is unphysical; it must be finite and above 0")
        self._parameters = changed
        self.set_temperature(self.celsius)

    def set_temperature(self, celsius: float) -> None:
        """Set the slide-way's temperature: ft and Cd follow it."""
        self.celsius = celsius
        rise = celsius - self._reference_c
        ft, Cd = (max(1 + rate * rise, 0.0) for rate in self._per_kelvin)
        base = self._parameters
        now = replace(base, ft=base.ft * ft, Cd=base.Cd * Cd)
        if now != self.physics.parameters:
            self.physics.set_parameters(now)


def _create_physics(
    parameters: Parameters, config: MachineConfig, axis: str, sim_axis: SimAxis, rad_per_mm: float
) -> PlantPhysics:
    """Create the axis' mechanics and loops: the paper's, or a real machine's where it is configured."""
    section = config.axis[axis]
    increments, period_s = section.drive.increments_per_rev, config.machine.sync_period_s
    start_rad, backlash_rad = sim_axis.start_mm * rad_per_mm, abs(sim_axis.backlash_um * 1e-3 * rad_per_mm)
    loops = section.regulators
    if is_plain(sim_axis.reality, loops):
        return PlantPhysics(parameters, loops, period_s, increments, angle_rad=start_rad, backlash_rad=backlash_rad)
    return RealPlantPhysics(
        parameters, loops, period_s, increments, sim_axis.reality,
        rad_per_mm=rad_per_mm, angle_rad=start_rad, backlash_rad=backlash_rad,
    )  # fmt: skip


def select_sensor_noise(config: MachineConfig, sim_axis: SimAxis) -> Noise:
    """Return the sensors' white noise; a speed derived from encoder positions has none of its own."""
    white = sim_axis.reality.speed_object == "shaft"
    return config.sim.noise if white else config.sim.noise.model_copy(update={"speed_rad_s": 0.0})


def locate_switches(sim_axis: SimAxis, ratings: DriveRatings) -> Switches:
    """Return the positions of the machine's switches, in the drive's own direction."""
    per_mm = ratings.sign * ratings.increments_per_mm
    home = None if sim_axis.home_switch_mm is None else sim_axis.home_switch_mm * per_mm
    if sim_axis.limit_switches_mm is None:
        return Switches(home=home)
    negative, positive = sorted(position * per_mm for position in sim_axis.limit_switches_mm)
    return Switches(negative, positive, home)
