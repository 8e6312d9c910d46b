"""Compares operators and estimators on many noisy recordings of one rapid, with the Cramer-Rao bound."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fdhil.cli.paper.derivative_operators import OPERATORS
from fdhil.cli.paper.simulated_drive import FULL_SCALE, add_noise
from fdhil.config import Identification
from fdhil.identification import (
    PARAMETER_ORDER,
    ZERO_FORCING_1,
    DerivativeStencil,
    NoiseLevels,
    align_signals,
    build_problem,
    build_regressors,
    compute_jacobian,
    compute_moments,
    count_horizon_steps,
    estimate,
    estimate_typical_sizes,
    filter_zero_phase,
    find_windows,
    prepare_window,
    solve_two_steps,
)
from fdhil.records import PARAMETERS, Bool, Float, Parameters, Recording, Window, freeze_array

NOISES = (0.001, 0.005, 0.01)
NO_LOWPASS_HZ = 1e5
LOWPASSES_HZ = (NO_LOWPASS_HZ, Identification().lowpass_hz, 150.0)
METHODS = (*OPERATORS, "partial_moments", "maximum_likelihood")


@dataclass(frozen=True, slots=True)
class MethodErrors:
    """Relative errors at one noise: all (runs, low-passes, methods, 6), with raw voltage (runs, 6), and the bound."""

    noise: float
    relative: Float
    raw_voltage: Float
    bound: Float

    def compute_rms(self, lowpass: int) -> Float:
        """Return the RMS errors (methods, 6)."""
        return np.asarray(np.sqrt((self.relative[:, lowpass] ** 2).mean(axis=0)))

    def compare_with_bound(self, lowpass: int) -> Float:
        """Return the ratio of RMS error and bound per method, geometric mean of the six parameters, (methods,)."""
        return np.asarray(np.exp(np.log(self.compute_rms(lowpass) / self.bound).mean(axis=1)))


def compare_methods(parameters: Parameters, recording: Recording, runs: int) -> list[MethodErrors]:
    """Return the errors of all methods at each of ``NOISES`` over ``runs`` recordings."""
    true = convert_to_vector(parameters)
    found = []
    for noise in NOISES:
        of, raw = [], []
        for seed in range(runs):
            windows = add_noise(recording, noise, seed)
            likely = estimate(windows, Identification()).values
            of.append([[*_estimate_in_two_steps(windows, hz), likely] for hz in LOWPASSES_HZ])
            raw.append(estimate_least_squares(_filter_all_but_voltage(windows), NO_LOWPASS_HZ))
        relative = np.array(of) / true - 1.0, np.array(raw) / true - 1.0
        found.append(MethodErrors(noise, *relative, compute_cramer_rao_bound(parameters, recording, noise) / true))
    return found


def convert_to_vector(parameters: Parameters) -> Float:
    """Return the six parameters (6,)."""
    return np.array([getattr(parameters, name) for name in PARAMETERS])


def _estimate_in_two_steps(windows: Sequence[Window], lowpass_hz: float) -> list[Float]:
    found = [estimate_least_squares(windows, lowpass_hz, operator) for operator in OPERATORS.values()]
    steps = count_horizon_steps(Identification(lowpass_hz=lowpass_hz), windows[0].dt_s)
    return [*found, _solve_two_steps([compute_moments(window, steps) for window in windows])]


def estimate_least_squares(
    windows: Sequence[Window],
    lowpass_hz: float,
    operator: DerivativeStencil = ZERO_FORCING_1,
    rows: Sequence[Bool] | None = None,
) -> Float:
    """Return [R, L, K, Jt, ft, Cd] (6,) by least squares, from all or selected ``rows`` (n,) of each window."""
    parts = []
    for k, window in enumerate(windows):
        signals = align_signals(window, Identification(lowpass_hz=lowpass_hz))
        if rows is not None:
            signals = replace(signals, usable=signals.usable & rows[k])
        parts.append(build_regressors(signals, window.dt_s, operator))
    return _solve_two_steps(parts)


def _solve_two_steps(parts: Sequence[tuple[Float, Float]]) -> Float:
    electrical, mechanical = (np.vstack([part[k] for part in parts]) for k in (0, 1))
    values: Float = solve_two_steps(electrical, mechanical)[0][PARAMETER_ORDER]
    return values


def _filter_all_but_voltage(windows: Sequence[Window]) -> list[Window]:
    hz = Identification().lowpass_hz
    return [
        replace(
            window,
            current_a=freeze_array(filter_zero_phase(window.current_a, hz, window.dt_s)),
            speed_rad_s=freeze_array(filter_zero_phase(window.speed_rad_s, hz, window.dt_s)),
        )
        for window in windows
    ]


def compare_raw_voltage(parameters: Parameters, recording: Recording, noise: float) -> tuple[Float, Float]:
    """Return the relative error of L (1,) with the low-pass on every signal, and without it on the voltage."""
    windows, true = add_noise(recording, noise, 0), convert_to_vector(parameters)
    filtered = estimate_least_squares(windows, Identification().lowpass_hz) / true - 1.0
    unfiltered = estimate_least_squares(_filter_all_but_voltage(windows), NO_LOWPASS_HZ) / true - 1.0
    place = PARAMETERS.index("L")
    return filtered[[place]], unfiltered[[place]]


def compute_cramer_rao_bound(parameters: Parameters, recording: Recording, noise: float) -> Float:
    """Return the Cramer-Rao standard deviations (6,) for the samples in which the drive is certainly moving."""
    theta = np.append(convert_to_vector(parameters), 0.0)
    motion = prepare_window(find_windows(recording)[0])
    problem = build_problem([motion], theta, [NoiseLevels(*np.full(3, noise * FULL_SCALE).tolist())])
    scales = estimate_typical_sizes(theta, [motion])
    slope = compute_jacobian(problem, theta, problem.compute_residuals(theta), range(6), scales)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(slope.T @ slope))))
