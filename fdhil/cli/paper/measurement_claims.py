"""Claims of sections 2.1, 3 and 4: figures 2 and 4 to 8, whiteness, backlash, drift of the parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from fdhil.cli.paper import claim_drawings, simulated_drive
from fdhil.cli.paper.claims import Claim, Picture, Trial, make_claim
from fdhil.cli.paper.method_comparison import convert_to_vector
from fdhil.cli.paper.scenarios import load_machine
from fdhil.cli.paper.simulated_drive import COLD_C, WARM_C, Disturbance, Move
from fdhil.config import Identification
from fdhil.identification import (
    PARAMETER_ORDER,
    align_signals,
    build_regressors,
    compute_residuals,
    fit_parameters_and_noise,
    prepare_window,
    solve_two_steps,
)
from fdhil.identification import estimate as estimate_maximum_likelihood
from fdhil.pipeline import analyse_window
from fdhil.records import UNITS, Estimate, Float, Window, WindowOutcome, compute_rms
from fdhil.report import DISPLAY_UNITS, Table, draw_signals, draw_torque, simulate_speed
from fdhil.validation import measure_dead_band

TEMPERATURES_C = (20.0, 20.5, 21.0, 21.5, 22.0)
SURE = 1.96  # standard deviations
LAGS = 20
SLOW = 0.4  # of the rapid speed
WHITE = 0.15  # [LAN 93] calls residuals white in practice whose normalised correlations stay below this
RAPID_RAD_S = 60.0
QUIET = 1e-6
RIPPLE = Disturbance(ripple_nm=1.0)


@dataclass(frozen=True, slots=True)
class DriftSeries:
    """Estimates at each of ``TEMPERATURES_C`` in one scenario."""

    estimates: Sequence[Estimate]

    def collect_series(self, name: str) -> tuple[Float, Float, Float]:
        """Return temperature, value and standard deviation, (n,) each."""
        values = np.array([estimate.get_value(name) for estimate in self.estimates])
        return np.array(TEMPERATURES_C), values, np.array([estimate.get_std(name) for estimate in self.estimates])

    def compute_drop(self, name: str) -> tuple[float, float]:
        """Return the decrease from the coldest to the warmest, and its standard deviation."""
        _, values, std = self.collect_series(name)
        return float(values[0] - values[-1]), float(np.hypot(std[0], std[-1]))


def evaluate_claims() -> list[Claim]:
    """Evaluate the claims of sections 2.1, 3.2 and 4."""
    drifts = _identify_drifts()
    return [
        _evaluate_constancy(),
        _evaluate_architecture(),
        _evaluate_whiteness(),
        _evaluate_backlash(),
        _evaluate_signals(),
        _evaluate_torques(),
        _evaluate_drift("ft", 6, (1.2e-3, 0.8e-3), drifts),
        _evaluate_drift("Cd", 7, (2.4, 1.9), drifts),
        _evaluate_behaviour(),
    ]


@cache
def _analyse_rapid(noise: float, trouble: Disturbance = Disturbance()) -> WindowOutcome:  # noqa: B008 - frozen
    config = load_machine()
    recording = simulated_drive.record_rapids(simulated_drive.compute_parameters(), trouble=trouble, strokes=2)
    window = simulated_drive.add_noise(recording, noise, 0)[-1]
    return analyse_window(window, Identification(), config.axis["X"], config.machine.sync_period_s)


def _identify_drifts() -> Mapping[str, DriftSeries]:
    found: dict[str, list[Estimate]] = {"noise-0.1": [], "noise-0.5": [], "ten-rapids": []}
    for celsius in TEMPERATURES_C:
        plant = simulated_drive.compute_parameters(celsius=celsius)
        fast, slow = (
            simulated_drive.record_rapids(plant, celsius, move=Move.create_measured(share)) for share in (1.0, SLOW)
        )
        seed = round(10 * celsius)
        many = [
            w for k in range(5) for one in (fast, slow) for w in simulated_drive.add_noise(one, 0.005, 1000 * k + seed)
        ]
        for name, windows in (
            ("noise-0.1", simulated_drive.add_noise(fast, 0.001, seed)), ("noise-0.5", many[:1]), ("ten-rapids", many),
        ):  # fmt: skip
            found[name].append(estimate_maximum_likelihood(windows, Identification()))
    return {name: DriftSeries(estimates) for name, estimates in found.items()}


def _evaluate_constancy() -> Claim:
    time_constant_s = load_machine().sim.thermal.time_constant_s
    first = convert_to_vector(simulated_drive.compute_parameters())[4:] @ [RAPID_RAD_S, 1.0]
    trials = []
    for name, seconds in (("operation-10-s", 10.0), ("operation-1-min", 60.0), ("operation-10-min", 600.0)):
        celsius = COLD_C + (WARM_C - COLD_C) * (1.0 - np.exp(-seconds / time_constant_s))
        last = convert_to_vector(simulated_drive.compute_parameters(celsius=float(celsius)))[4:] @ [RAPID_RAD_S, 1.0]
        trials.append(Trial(name, "change of the friction at 60 rad/s", 100.0 * float(1 - last / first), "%", most=5.0))
    return make_claim("claim-constant", trials)


def _evaluate_architecture() -> Claim:
    sound = [("noise-0.1", 0.001), ("noise-0.5", 0.005)]
    wrong = [("backlash-20", Disturbance(backlash_um=20.0)), ("backlash-100", Disturbance(backlash_um=100.0))]
    trials = [
        Trial(name, "sound rapids accepted", float(_analyse_rapid(noise).verdict.accepted), "of 1", least=1.0)
        for name, noise in sound
    ]
    outcomes = [(name, _analyse_rapid(0.001, trouble)) for name, trouble in wrong]
    trials += [
        Trial(name, "rapids of another structure refused", float(not outcome.verdict.accepted), "of 1", least=1.0)
        for name, outcome in outcomes
    ]
    reasons = [[name, outcome.verdict.reasons[0].text] for name, outcome in outcomes if outcome.verdict.reasons]
    return make_claim("figure-2", trials, tables=[Table(("scenario", "reason of the refusal"), reasons)])


def compute_correlations(residual: Float) -> Float:
    """Return the normalised autocorrelations (LAGS,) of a residual (n,) at lags 1 to LAGS."""
    power = float(residual @ residual)
    return np.array([residual[lag:] @ residual[:-lag] for lag in range(1, LAGS + 1)]) / power


def _compute_residuals(window: Window) -> dict[str, Float]:
    # torque residuals of [6] by least squares, and innovations of the speed by maximum likelihood
    signals = align_signals(window, Identification())
    rows = build_regressors(signals, window.dt_s)
    theta, _ = solve_two_steps(*rows)
    motion = prepare_window(window)
    found = fit_parameters_and_noise([motion], np.append(theta[PARAMETER_ORDER], 0.0), range(6))
    surely = (np.abs(motion.mode) == 1) & motion.observed
    innovations = found.residuals[: 2 * motion.n].reshape(-1, 2)[surely, 1]
    return {"residuals": compute_residuals(theta, *rows)[1], "innovations": innovations}


def _evaluate_whiteness() -> Claim:
    trials, curves = [], {}
    for label, trouble in (("the paper's model", Disturbance()), ("a ripple of 1 N.m", RIPPLE)):
        recording = simulated_drive.record_rapids(simulated_drive.compute_parameters(), trouble=trouble)
        for name, residual in _compute_residuals(simulated_drive.add_noise(recording, 0.001, 0)[0]).items():
            found = compute_correlations(residual)
            worst = float(np.abs(found).max())
            what = f"largest correlation, {label}"
            bounds = {"least": WHITE} if trouble.ripple_nm else {"most": WHITE}
            trials.append(Trial(name, what, worst, "", **bounds))
            curves[f"{name}, {label}"] = found
    caption = f"Normalised autocorrelation of the residuals, lags 1 to {LAGS} of 1 ms, with the bounds of [LAN 93]."
    pictures = [Picture(caption, claim_drawings.draw_correlations(curves, WHITE))]
    return make_claim("claim-whiteness", trials, pictures, lags=LAGS, limit=WHITE)


def _evaluate_backlash() -> Claim:
    trials, rows = [], []
    for name, true in (("backlash-5", 5.0), ("backlash-20", 20.0), ("backlash-100", 100.0)):
        band = measure_dead_band(_analyse_rapid(0.001, Disturbance(backlash_um=true)).window)
        found, std = (float("nan"), float("nan")) if band is None else (band.um, band.std_um)
        trials.append(Trial(name, "dead band found over the true one", found / true, "x", least=0.8, most=1.2))
        rows.append([f"{true:g}", f"{found:.1f}", f"{std:.1f}"])
    return make_claim("claim-backlash", trials, tables=[Table(("true um", "found um", "standard deviation um"), rows)])


def _evaluate_signals() -> Claim:
    trials = []
    for name, noise in (("no-noise", QUIET), ("noise-0.1", 0.001), ("noise-0.5", 0.005)):
        window = _analyse_rapid(noise).window
        assert window.voltage_v is not None
        assert window.stages.cruise is not None
        cruise = np.abs(window.speed_rad_s[slice(*window.stages.cruise)])
        trials += [
            Trial(name, "speed in the cruise", float(np.median(cruise)), "rad/s", 55.0, 65.0),
            Trial(name, "largest voltage", float(np.abs(window.voltage_v).max()), "V", 30.0, 70.0),
            Trial(name, "largest current", float(np.abs(window.current_a).max()), "A", 10.0, 25.0),
        ]
    return make_claim(
        "figure-4",
        trials,
        pictures=[
            Picture(
                "Voltage, current and speed of one rapid of the measured machine, noise of 0.1 % of 70 V, A and rad/s.",
                draw_signals(
                    simulated_drive.add_noise(
                        simulated_drive.record_rapids(simulated_drive.compute_parameters()), 0.001, 0
                    )[0]
                ),
            )
        ],
    )


def _evaluate_torques() -> Claim:
    cases, trials, cruise = [], [], []
    for celsius in (COLD_C, WARM_C):
        window = simulated_drive.add_noise(
            simulated_drive.record_rapids(simulated_drive.compute_parameters(celsius=celsius), celsius),
            0.001,
            round(celsius),
        )[0]
        found = estimate_maximum_likelihood([window], Identification()).build_parameters()
        cases.append((f"{celsius:g} °C", window, found))
        cruise.append(found.Cd + found.ft * RAPID_RAD_S)
        speed = simulate_speed(window, found)
        peak = float(np.max(found.Jt * np.gradient(speed, window.dt_s) + found.ft * speed + found.Cd))
        trials.append(Trial("noise-0.1", f"largest torque at {celsius:g} degC", peak, "N.m", 10.0, 14.0))
    trials.append(Trial("noise-0.1", "torque of the cruise, cold less warm", cruise[0] - cruise[1], "N.m", 0.3, 0.8))
    return make_claim(
        "figure-5",
        trials,
        pictures=[
            Picture(
                "Torque Jt dw/dt + ft w + Cd sign(w) of one rapid by the parameters identified cold and warm.",
                draw_torque(cases),
            )
        ],
    )


def _evaluate_drift(symbol: str, number: int, printed: tuple[float, float], drifts: Mapping[str, DriftSeries]) -> Claim:
    trials = []
    true = printed[0] - printed[1]
    for name, drift in drifts.items():
        drop, std = drift.compute_drop(symbol)
        trials += [
            Trial(name, "printed fall, in standard deviations of the found one", true / std, "", least=SURE),
            Trial(name, "found less printed fall, in standard deviations", abs(drop - true) / std, "", most=3.0),
        ]
    rows = [
        [name, f"{celsius:g}", f"{value:.3g}", f"{SURE * std:.2g}"]
        for name, drift in drifts.items()
        for celsius, value, std in zip(*drift.collect_series(symbol), strict=True)
    ]
    caption = (
        f"{symbol} against the slide-ways' temperature, maximum likelihood, bars of 95 %; the line is that of the "
        "machine."
    )
    return make_claim(
        f"figure-{number}",
        trials,
        [Picture(caption, _draw_drift(symbol, printed, drifts))],
        [Table(("scenario", "°C", f"{symbol} {UNITS[symbol]}", "± 95 %"), rows, folded="The values")],
    )


def _draw_drift(symbol: str, printed: tuple[float, float], drifts: Mapping[str, DriftSeries]) -> str:
    unit, factor = DISPLAY_UNITS[symbol]
    series = {}
    for name, drift in drifts.items():
        celsius, values, std = drift.collect_series(symbol)
        series[name] = celsius, factor * values, factor * std
    shown = factor * printed[0], factor * printed[1]
    return claim_drawings.draw_drift(symbol, unit, series, shown)


def _evaluate_behaviour() -> Claim:
    trials, pictures = [], []
    for name, noise in (("no-noise", QUIET), ("noise-0.1", 0.001), ("noise-0.5", 0.005)):
        outcome = _analyse_rapid(noise)
        assert outcome.estimate is not None
        window, model = outcome.window, outcome.estimate.build_parameters()
        simulated = simulate_speed(window, model)
        missed = compute_rms(window.speed_rad_s - simulated)
        trials.append(
            Trial(name, "RMS between model and drive", 100.0 * missed / RAPID_RAD_S, "% of 60 rad/s", most=1.0)
        )
        if name == "noise-0.5":
            pictures.append(Picture(
                "Above, the speed of the drive and the model's answer to the same voltage, noise of 0.5 %; below, what "
                "is between them.",
                claim_drawings.draw_overlay(
                    np.arange(float(window.n)) * window.dt_s, "time (s)", "speed (rad/s)",
                    [("drive", window.direction * window.speed_rad_s), ("model", window.direction * simulated)],
                ),
            ))  # fmt: skip
    return make_claim("figure-8", trials, pictures=pictures)
