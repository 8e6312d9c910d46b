"""Holds what a drive moves: the axis' mechanics and loops, and how its parameters follow orders and the temperature."""

import math
from dataclasses import replace

from fdhil.config import MachineConfig, Noise, SimAxis
from fdhil.records import PARAMETERS, Parameters
from fdhil.sim.drive.homing import Switches
from fdhil.sim.drive.objects import Ratings
from fdhil.sim.drive.physics import Physics, true_parameters
from fdhil.sim.drive.reality import RealPhysics, is_plain


class AxisPlant:
    """The plant of one axis. ``mm_per_rad`` has the sign of the drive's direction; ``celsius`` is the slide-way's."""

    def __init__(self, config: MachineConfig, axis: str, twin: SimAxis) -> None:
        section = config.axis[axis]
        self.mm_per_rad = section.drive.sign * section.screw_pitch_mm / (2 * math.pi)
        self._reference_c = self.celsius = config.sim.thermal.ambient_c
        self._per_kelvin = (twin.ft_per_kelvin, twin.Cd_per_kelvin)
        self._parameters = true_parameters(section.nominal, twin)
        self.physics = _physics(self._parameters, config, axis, twin, 1 / self.mm_per_rad)

    def set_parameters(self, **values: float) -> None:
        """Change parameters at the reference temperature from the next cycle on; TypeError, ValueError if wrong."""
        unknown = [name for name in values if name not in PARAMETERS]
        if unknown:
            raise TypeError(f"{', '.join(unknown)} is no parameter of a drive")
        changed = self._parameters.changed(**values)
        for name, value in changed.as_dict().items():
            if not (math.isfinite(value) and value >= 0 and (value > 0 or name in ("ft", "Cd"))):
                raise ValueError(f"{name} = {value} is no value of a feed drive; it must be finite and above 0")
        self._parameters = changed
        self.warm(self.celsius)

    def warm(self, celsius: float) -> None:
        """The slide-way has this temperature: ft and Cd follow it."""
        self.celsius = celsius
        rise = celsius - self._reference_c
        ft, Cd = (max(1 + rate * rise, 0.0) for rate in self._per_kelvin)
        base = self._parameters
        now = replace(base, ft=base.ft * ft, Cd=base.Cd * Cd)
        if now != self.physics.parameters:
            self.physics.set_parameters(now)


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


def sensor_noise(config: MachineConfig, twin: SimAxis) -> Noise:
    """Return the sensors' white noise: a speed that is made of encoder positions has none of its own."""
    white = twin.reality.speed_object == "shaft"
    return config.sim.noise if white else config.sim.noise.model_copy(update={"speed_rad_s": 0.0})


def switches(twin: SimAxis, ratings: Ratings) -> Switches:
    """Return where the machine's switches are, in the drive's own direction."""
    per_mm = ratings.sign * ratings.increments_per_mm
    home = None if twin.home_switch_mm is None else twin.home_switch_mm * per_mm
    if twin.limit_switches_mm is None:
        return Switches(home=home)
    negative, positive = sorted(place * per_mm for place in twin.limit_switches_mm)
    return Switches(negative, positive, home)
