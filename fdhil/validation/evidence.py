"""Holds what the checks look at: a window, the estimate and fit that are judged, noise and resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fdhil.config import Axis, Identification
from fdhil.identification.delay import coarse_delay
from fdhil.identification.estimators import least_squares, maximum_likelihood
from fdhil.identification.estimators.maximum_likelihood import Fit
from fdhil.identification.motion import Noise, noise_levels, resolution
from fdhil.identification.windows import carried, moving_range, smooth
from fdhil.identification.without_voltage import TorqueFit
from fdhil.identification.without_voltage import fit as fit_torque
from fdhil.records import Bool, Estimate, Float, Window
from fdhil.validation.backlash import DeadBand, backlash
from fdhil.validation.sensor_reconstruction import Bridge
from fdhil.validation.simulation import fit_percent
from fdhil.validation.structure import Finding, findings

STILL_MM = 0.004  # of the table at rest
STILL_S, STILL_SHARE = 0.010, 0.02  # of the rapid speed
LEAST_ROWS = 32  # of a window that may hold a rapid move


@dataclass(frozen=True, slots=True)
class Signal:
    """One sensor over a window: its ``values`` (n,), and the smallest ``step`` between them (0: only one value)."""

    name: str
    unit: str
    values: Float
    step: float


def signals_of(window: Window) -> tuple[Signal, ...]:
    """Return the sensors that the window has in every row."""
    told = (
        ("voltage", "V", window.voltage_v),
        ("current", "A", window.current_a),
        ("speed", "rad/s", window.speed_rad_s),
    )
    return tuple(Signal(n, u, v, resolution(v[np.isfinite(v)])) for n, u, v in told if v is not None)


@dataclass(frozen=True)
class Evidence:
    """A window before any fit, or with its ``estimate`` and the ``fit`` of the same method (None: there is none).

    ``axis`` is the axis' section where it is known. Without a voltage the fit is ``torque``, of [2] alone.
    """

    window: Window
    settings: Identification
    estimate: Estimate | None = None
    fit: Fit | None = None
    axis: Axis | None = None

    @cached_property
    def signals(self) -> Sequence[Signal]:
        """The sensors, each with its resolution."""
        return signals_of(self.window)

    @cached_property
    def noise(self) -> Noise:
        """The noise of the three sensors."""
        return noise_levels(self.window)

    @cached_property
    def moving(self) -> tuple[int, int]:
        """The half-open rows of the move itself."""
        return moving_range(self.window)

    @cached_property
    def at_rest(self) -> Bool:
        """The rows (n,) in which the table surely stands still, from position and smoothed speed."""
        window = self.window
        position = carried(window.position_mm)
        reach = max(1, round(STILL_S / window.dt_s))
        ahead, behind = np.roll(position, -reach), np.roll(position, reach)
        still = (np.abs(ahead - position) < STILL_MM) & (np.abs(behind - position) < STILL_MM)
        still[:reach] &= np.abs(position[:reach] - position[0]) < STILL_MM
        still[-reach:] &= np.abs(position[-reach:] - position[-1]) < STILL_MM
        slow = np.abs(smooth(window.speed_rad_s, window.dt_s)) < STILL_SHARE * window.rapid_speed_rad_s
        return still & slow & np.isfinite(window.speed_rad_s)

    @cached_property
    def play(self) -> DeadBand | None:
        """The backlash that the window shows."""
        return backlash(self.window)

    @cached_property
    def torque(self) -> TorqueFit | None:
        """The fit of [2] alone; None where hardly any row surely moves."""
        return fit_torque([self.window], self.settings)

    @property
    def judged(self) -> Fit:
        """The fit; only for checks that need one."""
        if self.fit is None:
            raise ValueError("there is no fit to judge")
        return self.fit

    @cached_property
    def late_s(self) -> float:
        """By how much the voltage is late (early: negative) where that is more than a sample, else 0."""
        delay = float(self.judged.theta[6])
        return delay if abs(delay) > max(self.window.dt_s, self.judged.problem.motions[0].voltage_period_s) else 0.0

    @cached_property
    def electrically_late(self) -> bool:
        """Whether [5] alone shows that delay in whole samples: no torque or friction can pass for it."""
        window = self.window
        if not self.late_s or window.voltage_v is None:
            return bool(self.late_s)
        return coarse_delay(least_squares.align(window, self.settings), window.dt_s) != 0.0

    @cached_property
    def on_time(self) -> Fit:
        """The fit, without a delay of more than a sample: what else is wrong moves it too, and has its own name."""
        if not self.late_s:
            return self.judged
        return maximum_likelihood.fit(self.judged.problem.motions, np.append(self.judged.theta[:6], 0.0), range(6))

    @cached_property
    def fit_percent(self) -> float | None:
        """How much of the measured speed the estimate explains when it is simulated from the measured voltage."""
        return None if self.estimate is None else fit_percent(self.window, self.estimate, self.fit)

    @cached_property
    def bridge(self) -> Bridge | None:
        """The fitted window across which one sensor is told by the others; None where the fit cannot tell it."""
        if self.fit is None:
            return None
        motion, theta = self.fit.problem.motions[0], self.fit.theta
        finite = bool(np.isfinite(theta).all() and np.isfinite(self.fit.problem.noises[0].vector()).all())
        bears = motion.slow is None and finite and bool((theta[:4] > 0).all()) and abs(theta[6]) <= motion.dt_s
        return Bridge.over(self.fit) if bears else None

    @cached_property
    def findings(self) -> list[Finding]:
        """What the fit shows beyond the model, the most significant first."""
        return findings(self.on_time)

    def time_s(self, row: int) -> float:
        """Return the time of a row as its recording counts it."""
        return self.window.start_s + row * self.window.dt_s
