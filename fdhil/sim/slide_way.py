"""Simulates a slide-way's temperature: first order, heated by motion ([DES] 3.2: ft and Cd fall with it)."""

from fdhil.config import Thermal


class SlideWay:
    """The slide-way of one axis.

    ``celsius`` follows ambient + rise |v| / v_rapid with the configured time constant.
    """

    def __init__(self, thermal: Thermal, rapid_speed_rad_s: float, period_s: float) -> None:
        self._ambient_c = thermal.ambient_c
        self._rise_per_rad_s = thermal.rise_c / rapid_speed_rad_s
        self._part = period_s / thermal.time_constant_s
        self.celsius = thermal.ambient_c

    def advance_temperature(self, speed_rad_s: float) -> float:
        """Advance one SYNC cycle at this shaft speed; return the temperature."""
        target = self._ambient_c + self._rise_per_rad_s * abs(speed_rad_s)
        self.celsius += self._part * (target - self.celsius)
        return self.celsius
