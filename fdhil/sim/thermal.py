"""Warms a slide-way: one time constant, warmed in proportion to speed ([DES] 3.2: ft and Cd fall as it rises)."""

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

    def step(self, speed_rad_s: float) -> float:
        """Go one SYNC cycle on at this shaft speed; return the temperature."""
        target = self._ambient_c + self._rise_per_rad_s * abs(speed_rad_s)
        self.celsius += self._part * (target - self.celsius)
        return self.celsius
