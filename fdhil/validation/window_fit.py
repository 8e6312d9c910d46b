"""Holds the fit of a window: what its innovations show beyond the model, and the estimate with wider intervals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fdhil.identification import (
    LikelihoodFit,
    TorqueFit,
    align_signals,
    estimate_coarse_delay,
    exclude_delay,
    fit_parameters_and_noise,
    set_delay,
)
from fdhil.records import PARAMETERS, Estimate, Parameters, Reason, Window
from fdhil.validation.breakaway import Breakaway, measure_breakaway
from fdhil.validation.model_deficiencies import Deficiency, inflate_covariance, select_deficiencies
from fdhil.validation.move_replay import fill_missing_winding
from fdhil.validation.open_loop_simulation import compute_fit_percent
from fdhil.validation.residual_whiteness import find_autocorrelation, find_excess_noise
from fdhil.validation.score_tests import Finding
from fdhil.validation.sensor_reconstruction import SensorReconstruction
from fdhil.validation.signal_delays import SignalDelay, build_delay_findings, estimate_delays
from fdhil.validation.structure_tests import DEAD_TIME, run_structure_tests
from fdhil.validation.window_signals import WindowSignals


@dataclass(frozen=True)
class WindowFit:
    """The ``estimate`` of a window, and the ``fit`` of both equations by the same method (None: there is none).

    Without a voltage, equation [2] alone is fitted: ``torque``.
    """

    signals: WindowSignals
    estimate: Estimate | None = None
    fit: LikelihoodFit | None = None
    torque: TorqueFit | None = None

    @property
    def window(self) -> Window:
        """The window that is fitted."""
        return self.signals.window

    @property
    def required_fit(self) -> LikelihoodFit:
        """The fit; ValueError without one."""
        if self.fit is None:
            raise ValueError("the window has no fit")
        return self.fit

    @cached_property
    def parameters(self) -> Parameters | None:
        """The estimate as a drive that can be simulated; R and L that it lacks are the fit's or the data sheet's."""
        if self.estimate is None or not set(PARAMETERS) <= set(self.estimate.names):
            return None
        estimated = self.estimate.build_parameters()
        if self.fit is not None:
            estimated = fill_missing_winding(estimated, Parameters(*self.fit.theta[:6]))
        if self.signals.axis is not None:
            return fill_missing_winding(estimated, Parameters(**self.signals.axis.nominal.model_dump()))
        # behind an ordinary current loop R and L, which need a voltage, have no effect
        return estimated if self.signals.has_voltage else estimated.replace_values(R=1.0, L=1.0)

    @cached_property
    def fit_percent(self) -> float | None:
        """Share of the measured speed that the estimate explains when it is simulated from the measured voltage, %."""
        return None if self.estimate is None else compute_fit_percent(self.window, self.estimate, self.fit)

    @cached_property
    def voltage_delay_s(self) -> float:
        """The delay of the voltage (early: negative) where it is more than a sample, else 0."""
        delay = float(self.required_fit.theta[6])
        sample_s = max(self.window.dt_s, self.required_fit.problem.motions[0].voltage_period_s)
        return delay if abs(delay) > sample_s else 0.0

    @cached_property
    def is_electrically_delayed(self) -> bool:
        """Whether [5] alone shows that delay in whole samples: no torque or friction can imitate it there."""
        window = self.window
        if not self.voltage_delay_s or window.voltage_v is None:
            return bool(self.voltage_delay_s)
        return estimate_coarse_delay(align_signals(window, self.signals.settings), window.dt_s) != 0.0

    @cached_property
    def aligned_fit(self) -> LikelihoodFit:
        """The fit without a delay of more than a sample: other faults shift that delay, and have names of their own."""
        whole = self.required_fit
        if not self.voltage_delay_s:
            return whole
        return fit_parameters_and_noise(whole.problem.motions, set_delay(whole.theta, 0.0), exclude_delay(whole.free))

    @cached_property
    def has_sound_fit(self) -> bool:
        """Whether there is a fit whose residuals and information are finite."""
        if self.fit is None:
            return False
        return bool(np.isfinite(self.aligned_fit.residuals).all() and np.isfinite(self.aligned_fit.information).all())

    @cached_property
    def reconstruction(self) -> SensorReconstruction | None:
        """The fit by which one sensor is reconstructed from the others; None where the fit does not allow that."""
        if self.fit is None:
            return None
        motion, theta = self.fit.problem.motions[0], self.fit.theta
        finite = bool(np.isfinite(theta).all() and np.isfinite(self.fit.problem.noises[0].to_array()).all())
        usable = motion.slow is None and finite and bool((theta[:4] > 0).all()) and abs(theta[6]) <= motion.dt_s
        return SensorReconstruction.prepare(self.fit) if usable else None

    @cached_property
    def findings(self) -> list[Finding]:
        """What the innovations show beyond the model, the most significant first."""
        return run_structure_tests(self.aligned_fit)

    @cached_property
    def delays(self) -> tuple[SignalDelay, SignalDelay]:
        """The delays of voltage and current that the innovations show."""
        return estimate_delays(self.aligned_fit)

    @cached_property
    def deficiencies(self) -> list[Deficiency]:
        """The significant findings, each in addition to those before it."""
        if not self.has_sound_fit:
            return []
        late = build_delay_findings(self.delays) if self.window.slow_voltage is None else []
        return select_deficiencies(self.aligned_fit, [*self.findings, *late])

    @cached_property
    def autocorrelation(self) -> list[tuple[str, Reason]]:
        """The signals whose innovations are autocorrelated, each with its reason."""
        return list(find_autocorrelation(self.aligned_fit))

    @cached_property
    def excess_noise(self) -> list[tuple[str, Reason]]:
        """The signals for which the fit needs more noise than they scatter, each with its reason."""
        return list(find_excess_noise(self.aligned_fit, self.window))

    @cached_property
    def widened_estimate(self) -> Estimate | None:
        """The estimate with intervals that cover the bias by what the model lacks."""
        if self.estimate is None or not self.has_sound_fit:
            return self.estimate
        restless = {name for name, _ in (*self.autocorrelation, *self.excess_noise)}
        named = any(each.finding.is_relevant for each in self.deficiencies)
        nameless = bool(restless) and not named
        return inflate_covariance(self.estimate, self.aligned_fit, self.deficiencies, restless, nameless=nameless)

    @cached_property
    def breakaway(self) -> Breakaway | None:
        """The torque that the move takes to begin beyond the model's friction."""
        return measure_breakaway(self.window, self.aligned_fit) if self.has_sound_fit else None

    @cached_property
    def lost_voltage_v(self) -> float:
        """The part of the recorded voltage that does not reach the motor: a term of the estimate, or a deficiency."""
        found = [abs(each.finding.amplitude) for each in self.deficiencies if each.finding.name == DEAD_TIME]
        term = self.parameters.get_term("dead_time") if self.parameters is not None else 0.0
        return abs(term) + sum(found)
