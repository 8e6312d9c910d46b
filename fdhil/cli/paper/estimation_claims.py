"""Claims of sections 2 and 3.1: equations [3] to [8], derivative operators, partial moments, low-pass, load."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.cli.paper import claim_drawings, method_comparison, simulated_drive
from fdhil.cli.paper.claims import Claim, Picture, Trial, make_claim
from fdhil.cli.paper.scenarios import load_machine
from fdhil.config import Identification
from fdhil.identification import (
    ZERO_FORCING_1,
    align_signals,
    build_regressors,
    compute_residuals,
    differentiate_signal,
    solve_two_steps,
)
from fdhil.prediction import build_nominal_models
from fdhil.records import PARAMETERS, Bool, Float, Recording, Window
from fdhil.report import Table

PRINTED = (0.2953, -1.386, 0.886, 0.2047)  # [4], from x(t - 2h) to x(t + h)
NOISE_NAMES = dict(zip(method_comparison.NOISES, ("noise-0.1", "noise-0.5", "noise-1"), strict=True))
LOWPASS_NAMES = ("no-lowpass", "lowpass-40", "lowpass-150")
QUICK_NAMES = ("quick-no-lowpass", "quick-40", "quick-150")
QUIET = 1e-6
CHANCE = 0.02  # random part of the ratio of two errors, from some dozens of runs
L, JT = PARAMETERS.index("L"), PARAMETERS.index("Jt")
RIVALS = slice(1, 4)  # the other three operators
MOMENTS = method_comparison.METHODS.index("partial_moments")
DISPLAYED = ("LS, zero forcing #1", "LS, zero forcing 3 taps", "LS, central", "LS, backward", "partial moments",
             "maximum likelihood")  # fmt: skip


@dataclass(frozen=True, slots=True)
class EstimationStudy:
    """Errors of all methods on the same noisy recordings of the measured machine, and of a faster one."""

    recording: Recording
    errors: Sequence[method_comparison.MethodErrors]
    quick: Sequence[method_comparison.MethodErrors]

    def list_cases(self) -> list[tuple[str, int, method_comparison.MethodErrors]]:
        """Return scenario, low-pass index and errors, grouped by scenario."""
        both = ((LOWPASS_NAMES, self.errors), (QUICK_NAMES, self.quick))
        return [(name, k, errors) for names, found in both for k, name in enumerate(names) for errors in found]


def run_estimators(runs: int) -> EstimationStudy:
    """Run all methods over ``runs`` recordings per noise level."""
    plant, simulator = simulated_drive.compute_parameters(), build_nominal_models(load_machine())["X"]
    recording = simulated_drive.record_rapids(plant)
    quick = simulated_drive.record_rapids(simulator, move=simulated_drive.QUICK)
    return EstimationStudy(
        recording,
        method_comparison.compare_methods(plant, recording, runs),
        method_comparison.compare_methods(simulator, quick, runs),
    )


def evaluate_claims(runs: int) -> list[Claim]:
    """Evaluate the claims of sections 2 and 3.1 over ``runs`` noisy recordings."""
    study = run_estimators(runs)
    return [
        _evaluate_least_squares(study),
        _evaluate_operator(),
        _evaluate_submodels(study),
        _evaluate_common_lowpass(study),
        _evaluate_operator_choice(study),
        _evaluate_moments(study),
        _evaluate_noise(study),
        _evaluate_no_load(),
        _evaluate_stages(study, runs),
    ]


def _compute_errors_percent(study: EstimationStudy, noise: float) -> Float:
    windows = simulated_drive.add_noise(study.recording, noise, 0)
    found = method_comparison.estimate_least_squares(windows, Identification().lowpass_hz)
    return 100.0 * np.abs(found / method_comparison.convert_to_vector(simulated_drive.compute_parameters()) - 1.0)


def _evaluate_least_squares(study: EstimationStudy) -> Claim:
    trials = [
        Trial(name, f"error of {symbol}", float(value), "%", most=5.0)
        for name, noise in (("no-noise", QUIET), *((name, noise) for noise, name in NOISE_NAMES.items()))
        for symbol, value in zip(PARAMETERS, _compute_errors_percent(study, noise), strict=True)
    ]
    return make_claim("equation-3", trials)


def _evaluate_operator() -> Claim:
    weights = np.abs(np.array(ZERO_FORCING_1.weights) - PRINTED).max()
    errors = [_measure_sine_error(period) for period in (2e-3, 1e-3)]
    order = float(np.log2(errors[0] / errors[1]))
    return make_claim(
        "equation-4",
        [
            Trial("operators", "largest difference of a weight", float(weights), "", most=5.1e-5),
            Trial("operators", "order of the error in h, at 5 Hz", order, "", least=1.9),
        ],
        pictures=[
            Picture(
                "Response of the four operators to a sine, over that of the exact derivative; 1 is without error. "
                "The frequency is given as a share of the sampling rate.",
                claim_drawings.draw_operators(),
            )
        ],
    )


def _measure_sine_error(period_s: float) -> float:
    rate = 2 * np.pi * 5.0
    times = np.arange(0.0, 1.0, period_s)
    found = differentiate_signal(np.sin(rate * times), period_s)
    return float(np.nanmax(np.abs(found - rate * np.cos(rate * times))))


def _evaluate_submodels(study: EstimationStudy) -> Claim:
    trials = []
    for name, noise in (("no-noise", QUIET), ("noise-0.1", 0.001), ("noise-0.5", 0.005)):
        (window,) = simulated_drive.add_noise(study.recording, noise, 0)
        signals = align_signals(window, Identification())
        rows = build_regressors(signals, window.dt_s)
        theta, _ = solve_two_steps(*rows)
        left = compute_residuals(theta, *rows)
        whole = rows[0][:, 0], theta[2] * rows[1][:, 0]
        trials += [
            Trial(name, f"left of {what}", 100.0 * float(np.std(r) / np.sqrt(np.mean(y**2))), "%", most=5.0)
            for what, r, y in zip(("the voltage by [5]", "the torque by [6]"), left, whole, strict=True)
        ]
    return make_claim("equation-5-6", trials)


def _evaluate_common_lowpass(study: EstimationStudy) -> Claim:
    quiet = method_comparison.compare_raw_voltage(simulated_drive.compute_parameters(), study.recording, QUIET)
    cases = [("no-noise", *quiet)]
    cases += [(NOISE_NAMES[e.noise], e.relative[:, 1, 0, L], e.raw_voltage[:, L]) for e in study.errors]
    trials = []
    for name, filtered, unfiltered in cases:
        even, uneven = (100.0 * abs(float(np.mean(errors))) for errors in (filtered, unfiltered))
        trials += [
            Trial(name, "bias of L, low-pass on every signal", even, "%", most=0.5),
            Trial(name, "bias of L without it on the voltage, over that", uneven / even, "x", least=2.0),
        ]
    return make_claim("equation-8", trials)


def _evaluate_operator_choice(study: EstimationStudy) -> Claim:
    trials = []
    for name, k, errors in study.list_cases():
        ratios = errors.compare_with_bound(k)
        what = f"best rival over zero forcing #1, noise {100 * errors.noise:g} %"
        trials.append(Trial(name, what, float(ratios[RIVALS].min() / ratios[0]), "x", least=1.0 - CHANCE))
    return make_claim(
        "claim-operator",
        trials,
        pictures=[
            Picture(
                "RMS error of each parameter over the bound of Cramer and Rao, noise of 0.5 %, low-pass of 40 Hz "
                "(maximum likelihood uses none). 1 is the optimum.",
                claim_drawings.draw_over_bound(study.errors[1].compute_rms(1) / study.errors[1].bound, DISPLAYED),
            )
        ],
        tables=[_build_error_table(study, k) for k in range(len(LOWPASS_NAMES))],
    )


def _build_error_table(study: EstimationStudy, lowpass: int) -> Table:
    errors = study.errors[1]
    rms = errors.compute_rms(lowpass)
    rows = [
        [symbol, *(f"{100 * rms[m, p]:.3g}" for m in range(len(DISPLAYED))), f"{100 * errors.bound[p]:.3g}"]
        for p, symbol in enumerate(PARAMETERS)
    ]
    rows.append(["all, over the bound", *(f"{ratio:.2f}" for ratio in errors.compare_with_bound(lowpass)), "1"])
    caption = f"RMS error in % of the true value, noise of 0.5 %, {LOWPASS_NAMES[lowpass]}"
    folded = "" if LOWPASS_NAMES[lowpass] == "lowpass-40" else caption
    return Table(("parameter", *DISPLAYED, "Cramer-Rao bound"), rows, caption, folded)


def _evaluate_moments(study: EstimationStudy) -> Claim:
    trials = []
    for name, k, errors in study.list_cases():
        ratios = errors.compare_with_bound(k)
        what = f"moments over least squares, noise {100 * errors.noise:g} %"
        trials.append(Trial(name, what, float(ratios[MOMENTS] / ratios[0]), "x", least=1.0))
    return make_claim("claim-moments", trials)


def _evaluate_noise(study: EstimationStudy) -> Claim:
    trials = []
    for errors in study.errors:
        raw, filtered = (100.0 * abs(float(errors.relative[:, k, 0, JT].mean())) for k in (0, 1))
        name = NOISE_NAMES[errors.noise]
        trials += [
            Trial(name, "bias of Jt without a low-pass", raw, "%", least=5.0),
            Trial(name, "bias of Jt with 40 Hz", filtered, "%", most=5.0),
        ]
    return make_claim("claim-noise", trials)


def _evaluate_no_load() -> Claim:
    free, loaded = (
        simulated_drive.record_rapids(
            simulated_drive.compute_parameters(), trouble=simulated_drive.Disturbance(load_nm=load), strokes=2
        )
        for load in (0.0, 1.0)
    )
    trials = []
    for name, recording, taken in (
        ("load-0", free, slice(0, 1)), ("load-1", loaded, slice(0, 1)), ("load-1-both-ways", loaded, slice(0, 2)),
    ):  # fmt: skip
        windows = simulated_drive.add_noise(recording, 0.001, 0)[taken]
        found = method_comparison.estimate_least_squares(windows, Identification().lowpass_hz)
        error = 100.0 * abs(float(found[-1] / simulated_drive.compute_parameters().Cd - 1.0))
        trials.append(Trial(name, "error of Cd", error, "%", most=5.0))
    return make_claim("claim-no-load", trials)


def _evaluate_stages(study: EstimationStudy, runs: int) -> Claim:
    spread = {
        part: np.array(
            [
                _identify_mechanical(simulated_drive.add_noise(study.recording, 0.001, seed), part)
                for seed in range(runs)
            ]
        )
        for part in ("both", "acceleration", "cruise")
    }
    true = method_comparison.convert_to_vector(simulated_drive.compute_parameters())[3:]
    over = {part: np.exp(np.log(np.mean((v / true - 1.0) ** 2, axis=0)).mean() / 2) for part, v in spread.items()}
    trials = [
        Trial(
            "noise-0.1",
            f"error from {part} alone, over that from both",
            float(over[part] / over["both"]),
            "x",
            least=1.0,
        )
        for part in ("acceleration", "cruise")
    ]
    return make_claim("claim-stages", trials)


def _identify_mechanical(windows: Sequence[Window], part: str) -> Float:
    rows: list[Bool] = []
    for window in windows:
        kept = np.zeros(window.n, dtype=np.bool_)
        for stage, found in (("acceleration", window.stages.accelerate), ("cruise", window.stages.cruise)):
            if found is not None and part in (stage, "both"):
                kept[slice(*found)] = True
        rows.append(kept)
    return method_comparison.estimate_least_squares(windows, Identification().lowpass_hz, rows=rows)[3:]
