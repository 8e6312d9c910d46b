"""Section 2 and 3.1 of the paper: equations [3] to [8], the operators, the rival method, the low-pass, the load."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.cli.paper import bench, drawings, methods
from fdhil.cli.paper.claims import Claim, Picture, Trial
from fdhil.cli.paper.scenarios import machine
from fdhil.config import Identification
from fdhil.identification.derivatives import ZERO_FORCING_1, derivative
from fdhil.identification.estimators import least_squares
from fdhil.prediction.models import nominal_models
from fdhil.records import PARAMETERS, Bool, Float, Recording, Window
from fdhil.report import Table

PRINTED = (0.2953, -1.386, 0.886, 0.2047)  # [4], from x(t - 2h) to x(t + h)
NOISE_NAMES = dict(zip(methods.NOISES, ("noise-0.1", "noise-0.5", "noise-1"), strict=True))
LOWPASS_NAMES = ("no-lowpass", "lowpass-40", "lowpass-150")
QUICK_NAMES = ("quick-no-lowpass", "quick-40", "quick-150")
QUIET = 1e-6
CHANCE = 0.02  # of two errors' ratio, from some dozens of runs
L, JT = PARAMETERS.index("L"), PARAMETERS.index("Jt")
RIVALS = slice(1, 4)  # of the methods: the other three operators
MOMENTS = methods.METHODS.index("partial_moments")
DISPLAYED = ("LS, zero forcing #1", "LS, zero forcing 3 taps", "LS, central", "LS, backward", "partial moments",
             "maximum likelihood")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Estimating:
    """What the methods made of the same noisy recordings of the measured machine, and of a quicker one."""

    recording: Recording
    errors: Sequence[methods.Errors]
    quick: Sequence[methods.Errors]

    def cases(self) -> list[tuple[str, int, methods.Errors]]:
        """Return scenario, low-pass and errors, all noises of a scenario together."""
        both = ((LOWPASS_NAMES, self.errors), (QUICK_NAMES, self.quick))
        return [(name, k, errors) for names, found in both for k, name in enumerate(names) for errors in found]


def measure(runs: int) -> Estimating:
    """Run all methods over ``runs`` recordings a noise."""
    plant, simulator = bench.plant(), nominal_models(machine())["X"]
    recording = bench.rapid(plant)
    quick = bench.rapid(simulator, move=bench.QUICK)
    return Estimating(recording, methods.compare(plant, recording, runs), methods.compare(simulator, quick, runs))


def claims(runs: int) -> list[Claim]:
    """Return the claims of sections 2 and 3.1, each over ``runs`` noisy recordings."""
    told = measure(runs)
    return [
        _least_squares(told),
        _operator(),
        _submodels(told),
        _alike(told),
        _best_operator(told),
        _moments(told),
        _noise(told),
        _no_load(),
        _stages(told, runs),
    ]


def _errors_percent(told: Estimating, noise: float) -> Float:
    """Return the largest of the six errors of one noise-free or noisy identification, %."""
    windows = bench.noisy(told.recording, noise, 0)
    found = methods.least_squares_of(windows, Identification().lowpass_hz)
    return 100.0 * np.abs(found / methods.vector(bench.plant()) - 1.0)


def _least_squares(told: Estimating) -> Claim:
    trials = [
        Trial(name, f"error of {symbol}", float(value), "%", most=5.0)
        for name, noise in (("no-noise", QUIET), *((name, noise) for noise, name in NOISE_NAMES.items()))
        for symbol, value in zip(PARAMETERS, _errors_percent(told, noise), strict=True)
    ]
    return Claim(
        key="equation-3", title="least squares finds the six parameters",
        kind="equation", source="Equations [3] and [7], section 2.2",
        says="The physical parameters follow from [y] = [phi] [theta] by least squares: "
             "theta = (phi' phi)^-1 phi' y.",
        paper="no figures are given",
        rule="each of the six parameters within 5 % of the machine's, from one rapid with a low-pass of 40 Hz",
        trials=trials,
        note="Friction of 1.2e-3 N.m.s at 60 rad/s is 3 % of the dry friction beside it: one rapid at one speed hardly "
             "parts the two, and noise goes into ft first.",
    )  # fmt: skip


def _operator() -> Claim:
    weights = np.abs(np.array(ZERO_FORCING_1.weights) - PRINTED).max()
    errors = [_sine_error(period) for period in (2e-3, 1e-3)]
    order = float(np.log2(errors[0] / errors[1]))
    return Claim(
        key="equation-4", title="the operator zero forcing #1",
        kind="equation", source="Equation [4], section 2.2",
        says="Dx(t) = (0.2047·x(t+h) + 0.886·x(t) - 1.386·x(t-h) + 0.2953·x(t-2h)) / h, zero forcing #1.",
        paper="0.2047, 0.886, -1.386, 0.2953",
        rule="its weights to the printed digits; its error falls with the square of h or faster",
        trials=[
            Trial("operators", "largest difference of a weight", float(weights), "", most=5.1e-5),
            Trial("operators", "order of the error in h, at 5 Hz", order, "", least=1.9),
        ],
        pictures=[Picture(
            "Response of the four operators to a sine, over that of the exact derivative; 1 is without error. "
            "The frequency is given as a share of the sampling rate.", drawings.operators(),
        )],
    )  # fmt: skip


def _sine_error(period_s: float) -> float:
    rate = 2 * np.pi * 5.0
    times = np.arange(0.0, 1.0, period_s)
    found = derivative(np.sin(rate * times), period_s)
    return float(np.nanmax(np.abs(found - rate * np.cos(rate * times))))


def _submodels(told: Estimating) -> Claim:
    trials = []
    for name, noise in (("no-noise", QUIET), ("noise-0.1", 0.001), ("noise-0.5", 0.005)):
        (window,) = bench.noisy(told.recording, noise, 0)
        signals = least_squares.align(window, Identification())
        rows = least_squares.regressors(signals, window.dt_s)
        theta, _ = least_squares.solve_two_steps(*rows)
        left = least_squares.residuals_of(theta, *rows)
        whole = rows[0][:, 0], theta[2] * rows[1][:, 0]
        trials += [
            Trial(name, f"left of {what}", 100.0 * float(np.std(r) / np.sqrt(np.mean(y**2))), "%", most=5.0)
            for what, r, y in zip(("the voltage by [5]", "the torque by [6]"), left, whole, strict=True)
        ]
    return Claim(
        key="equation-5-6", title="two submodels explain voltage and torque",
        kind="equation", source="Equations [5] and [6], section 2.2",
        says="u = L Di + R i + K w and i = Jt/K Dw + ft/K w + Cd/K: two submodels, estimated one after the other.",
        paper="no figures are given",
        rule="each leaves at most 5 % (RMS) of what it explains",
        trials=trials,
        note="The friction term is Cd sign(w): as printed, [6] holds for motion in the positive direction alone.",
    )  # fmt: skip


def _alike(told: Estimating) -> Claim:
    quiet = methods.left_raw_of(bench.plant(), told.recording, QUIET)
    cases = [("no-noise", *quiet)]
    cases += [(NOISE_NAMES[e.noise], e.of[:, 1, 0, L], e.raw_voltage[:, L]) for e in told.errors]
    trials = []
    for name, alike, apart in cases:
        even, uneven = (100.0 * abs(float(np.mean(errors))) for errors in (alike, apart))
        trials += [
            Trial(name, "bias of L, low-pass on every signal", even, "%", most=0.5),
            Trial(name, "bias of L without it on the voltage, over that", uneven / even, "x", least=2.0),
        ]
    return Claim(
        key="equation-8", title="the same low-pass on every signal",
        kind="equation", source="Equation [8], section 3.1",
        says="Each signal must be filtered the same way: F Y / F U = Y / U = H.",
        paper="no figures are given",
        rule="the same 40 Hz on every signal biases L by at most 0.5 %; sparing the voltage at least doubles that",
        trials=trials,
        note="With noise the low-pass, however even, leaves some of it in the regressors, and that biases L by itself.",
    )  # fmt: skip


def _best_operator(told: Estimating) -> Claim:
    trials = []
    for name, k, errors in told.cases():
        ratios = errors.over_bound(k)
        what = f"best rival over zero forcing #1, noise {100 * errors.noise:g} %"
        trials.append(Trial(name, what, float(ratios[RIVALS].min() / ratios[0]), "x", least=1.0 - CHANCE))
    return Claim(
        key="claim-operator", title="zero forcing #1 is the best of four operators",
        kind="claim", source="Section 2.2",
        says="Of four derivative approximation operators, zero forcing #1 gives the most accurate parameters.",
        paper="the best of four; the other three are not named",
        rule="RMS error over the bound, geometric mean of the six parameters: every rival at least as far off (2 % are "
             "chance)",
        trials=trials,
        tables=[_table(told, k) for k in range(len(LOWPASS_NAMES))],
        pictures=[Picture(
            "RMS error of each parameter over the bound of Cramer and Rao, noise of 0.5 %, low-pass of 40 Hz (maximum "
            "likelihood uses none). At 1 nothing is left to gain.",
            drawings.over_bound(told.errors[1].rms(1) / told.errors[1].bound, DISPLAYED),
        )],
        note="The rivals here are zero forcing with three taps, central and backward differences.",
    )  # fmt: skip


def _table(told: Estimating, lowpass: int) -> Table:
    """Return the RMS errors of all methods at 0.5 % noise with the Cramer-Rao bound beside them."""
    errors = told.errors[1]
    rms = errors.rms(lowpass)
    rows = [
        [symbol, *(f"{100 * rms[m, p]:.3g}" for m in range(len(DISPLAYED))), f"{100 * errors.bound[p]:.3g}"]
        for p, symbol in enumerate(PARAMETERS)
    ]
    rows.append(["all, over the bound", *(f"{ratio:.2f}" for ratio in errors.over_bound(lowpass)), "1"])
    caption = f"RMS error in % of the true value, noise of 0.5 %, {LOWPASS_NAMES[lowpass]}"
    folded = "" if LOWPASS_NAMES[lowpass] == "lowpass-40" else caption
    return Table(("parameter", *DISPLAYED, "Cramer-Rao bound"), rows, caption, folded)


def _moments(told: Estimating) -> Claim:
    trials = []
    for name, k, errors in told.cases():
        ratios = errors.over_bound(k)
        what = f"moments over least squares, noise {100 * errors.noise:g} %"
        trials.append(Trial(name, what, float(ratios[MOMENTS] / ratios[0]), "x", least=1.0))
    return Claim(
        key="claim-moments", title="least squares beats the partial moments",
        kind="claim", source="Section 2.2",
        says="The method based on derivative approximation gives more accurate parameters than the reinitialised "
             "partial moments.",
        paper="after [DES 99]; no figures are given",
        rule="RMS error over the bound, geometric mean of the six: the moments at least as far off as least squares",
        trials=trials,
        note="The moments' horizon is a low-pass of its own: one period of the corner, at least eight samples.",
    )  # fmt: skip


def _noise(told: Estimating) -> Claim:
    trials = []
    for errors in told.errors:
        raw, filtered = (100.0 * abs(float(errors.of[:, k, 0, JT].mean())) for k in (0, 1))
        name = NOISE_NAMES[errors.noise]
        trials += [
            Trial(name, "bias of Jt without a low-pass", raw, "%", least=5.0),
            Trial(name, "bias of Jt with 40 Hz", filtered, "%", most=5.0),
        ]
    return Claim(
        key="claim-noise", title="noise ruins the derivative, a low-pass helps",
        kind="claim", source="Section 3.1",
        says="Noise generates errors on the derivative, which directly affect the parameters; a low-pass reduces that.",
        paper="no figures are given",
        rule="Jt biased by more than 5 % without a low-pass, by at most 5 % with 40 Hz",
        trials=trials,
    )  # fmt: skip


def _no_load() -> Claim:
    free, loaded = (bench.rapid(bench.plant(), trouble=bench.Trouble(load_nm=load), strokes=2) for load in (0.0, 1.0))
    trials = []
    for name, recording, taken in (
        ("load-0", free, slice(0, 1)), ("load-1", loaded, slice(0, 1)), ("load-1-both-ways", loaded, slice(0, 2)),
    ):  # fmt: skip
        windows = bench.noisy(recording, 0.001, 0)[taken]
        found = methods.least_squares_of(windows, Identification().lowpass_hz)
        error = 100.0 * abs(float(found[-1] / bench.plant().Cd - 1.0))
        trials.append(Trial(name, "error of Cd", error, "%", most=5.0))
    return Claim(
        key="claim-no-load", title="no load during rapids",
        kind="claim", source="Section 2.1",
        says="During G0 there is no machining, so Tl is zero and need not be measured: rapids are where to identify.",
        paper="no figures are given",
        rule="Cd within 5 % of the machine's",
        trials=trials,
        note="No cutting is not no load: a hanging axis has one in every rapid. Rapids both ways take it out of Cd.",
    )  # fmt: skip


def _stages(told: Estimating, runs: int) -> Claim:
    spread = {
        part: np.array([_mechanical(bench.noisy(told.recording, 0.001, seed), part) for seed in range(runs)])
        for part in ("both", "acceleration", "cruise")
    }
    true = methods.vector(bench.plant())[3:]
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
    return Claim(
        key="claim-stages", title="acceleration and cruise are both needed",
        kind="claim", source="Section 2.2",
        says="The acquisition must contain the acceleration and the stage at maximum speed: else the parameters of [6] "
             "are not accurate.",
        paper="no figures are given",
        rule="the RMS error, geometric mean of Jt, ft and Cd, is larger from either stage alone",
        trials=trials,
    )  # fmt: skip


def _mechanical(windows: Sequence[Window], part: str) -> Float:
    rows: list[Bool] = []
    for window in windows:
        kept = np.zeros(window.n, dtype=np.bool_)
        for stage, found in (("acceleration", window.stages.accelerate), ("cruise", window.stages.cruise)):
            if found is not None and part in (stage, "both"):
                kept[slice(*found)] = True
        rows.append(kept)
    return methods.least_squares_of(windows, Identification().lowpass_hz, rows=rows)[3:]
