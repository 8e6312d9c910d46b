"""Claims of section 5: figures 9 to 15, location of errors, influence of feed, friction, mass and cutting force."""

from collections.abc import Sequence

import numpy as np

from fdhil.cli.paper import claim_drawings, path_predictions, simulated_drive
from fdhil.cli.paper.claim_drawings import TracedPath, View
from fdhil.cli.paper.claims import Claim, Picture, Trial, make_claim
from fdhil.cli.paper.path_predictions import CORNERS, FAST, PLACES, SLOW, SMOOTH
from fdhil.cli.paper.scenarios import CASCADES, DEMANDED, PATHS, load_machine
from fdhil.cli.paper.simulated_drive import Move
from fdhil.config import Identification
from fdhil.identification import estimate
from fdhil.model import simulate_axes
from fdhil.prediction import build_nominal_models, compute_contour_error_um, predict_path
from fdhil.records import Float, Parameters, Prediction, compute_rms
from fdhil.report import Table, draw_path

DRAWN = ("full", "half", "sharp-lag")  # scenarios with drawings
LITTLE = 1.25  # ratio of the errors at both feeds that counts as a small influence
FRICTION = (("ft", 0.01), ("Cd", 1.0))
MASS = (("Jt", 0.085),)
FEW_UM = 5.0
SLOW_SHARE = 0.4


def evaluate_claims() -> list[Claim]:
    """Evaluate the claims of section 5."""
    return [
        _evaluate_structure(),
        _evaluate_abrupt_changes(),
        _evaluate_lower_feed(),
        _evaluate_prediction(),
        _evaluate_cutting_forces(),
        _evaluate_path(),
        _evaluate_feed_influence("A", 11, little=True),
        _evaluate_error_size(),
        _evaluate_feed_influence("C", 12, little=False),
        _evaluate_feed_influence("E", 13, little=False),
        _evaluate_drift(14, FRICTION, "ft 0.05 to 0.01 N.m.s and Cd 5 to 1 N.m on X"),
        _compare_drift_with_feed(),
        _evaluate_drift(15, MASS, "Jt 0.075 to 0.085 kg.m2 on X"),
    ]


def _evaluate_structure() -> Claim:
    trials = []
    for name in CASCADES:
        missed = np.abs(
            path_predictions.simulate_table_mm(name)
            - path_predictions.extract_path_mm(path_predictions.predict_path(name))
        ).max()
        trials.append(Trial(name, "largest difference of the two", 1e3 * float(missed), "um", most=5.0))
    return make_claim("equation-1-2", trials)


def _evaluate_abrupt_changes() -> Claim:
    trials, rows = [], []
    for name in PATHS:
        answer = path_predictions.predict_path(name)
        found = {place: path_predictions.find_largest_um(name, answer, place) for place in PLACES}
        ratio = min(found[place] for place in CORNERS) / max(found[place] for place in SMOOTH)
        trials.append(Trial(name, "least of A, C, E, G over the largest of B, D, F", ratio, "x", least=2.0))
        rows.append([name, *(f"{found[place]:.0f}" for place in PLACES)])
    return make_claim(
        "claim-abrupt",
        trials,
        tables=[Table(("scenario", *PLACES), rows, "Largest contour error near each place, um, 10 m/min")],
    )


def _evaluate_lower_feed() -> Claim:
    trials = []
    for name in PATHS:
        slow, fast = (
            path_predictions.compute_rms_um(name, path_predictions.predict_path(name, p), p) for p in (SLOW, FAST)
        )
        times = [path_predictions.load_reference(name, p).time_s[-1] for p in (SLOW, FAST)]
        trials += [
            Trial(name, "RMS error at 20 over that at 10 m/min", fast / slow, "x", least=1.05),
            Trial(name, "time at 10 over that at 20 m/min", float(times[0] / times[1]), "x", least=1.5),
        ]
    return make_claim("claim-feed", trials)


def identify_simulator() -> Parameters:
    """Identify the simulated drive from a fast and a slow rapid in both directions, noise of 0.1 %."""
    true = build_nominal_models(load_machine())["X"]
    recordings = [
        simulated_drive.record_rapids(true, strokes=2, move=Move.create_measured(share)) for share in (1.0, SLOW_SHARE)
    ]
    windows = [window for k, one in enumerate(recordings) for window in simulated_drive.add_noise(one, 0.001, k)]
    return estimate(windows, Identification()).build_parameters()


def _evaluate_prediction() -> Claim:
    model = identify_simulator()
    trials, pictures = [], []
    for name in CASCADES:
        config, reference = load_machine(name), path_predictions.load_reference(name)
        measured = compute_contour_error_um(reference.path_mm, path_predictions.simulate_table_mm(name), reference.dt_s)
        predicted = predict_path(reference, {"X": model, "Y": model}, config).contour_um
        missed = 100.0 * compute_rms(predicted - measured) / compute_rms(measured)
        trials.append(Trial(name, "RMS between predicted and measured, of the measured", missed, "%", most=10.0))
        if name in DRAWN:
            pictures.append(Picture(
                f"Contour error along the path at 10 m/min, {PATHS[name].title}: predicted from identified parameters "
                "and as the simulated machine has it; below, what is between them.",
                claim_drawings.draw_overlay(reference.time_s, "time (s)", "contour error (um)",
                                 [("machine", measured), ("predicted", predicted)]),
            ))  # fmt: skip
    return make_claim("figure-9", trials, pictures=pictures)


def _evaluate_cutting_forces() -> Claim:
    config = load_machine("full")
    axis, true = config.axis["X"], build_nominal_models(config)["X"]
    demand = SLOW_MM_S * np.arange(0.0, 1.0, config.machine.sync_period_s)
    free = simulated_drive.simulate_drive(axis, config.machine.sync_period_s, true, demand).table_mm
    trials = []
    for name, newton in (("force-30", 30.0), ("force-300", 300.0), ("force-3000", 3000.0)):
        load = np.where(np.arange(demand.size) < demand.size // 2, 0.0, newton * axis.screw_pitch_mm / 2e3 / np.pi)
        moved = simulated_drive.simulate_drive(axis, config.machine.sync_period_s, true, demand, load).table_mm - free
        trials.append(Trial(name, "table moved by the force", 1e3 * float(np.abs(moved).max()), "um", most=FEW_UM))
    return make_claim("claim-cutting", trials, limit_um=FEW_UM)


SLOW_MM_S = 10e3 / 60


def _evaluate_path() -> Claim:
    trials = []
    for name in DEMANDED:
        missed = max(
            float(np.hypot(*(path_predictions.load_reference(name).path_mm - place).T).min())
            for place in PLACES.values()
        )
        trials.append(Trial(name, "farthest of the places from the demand", missed, "mm", most=0.1))
    desired = path_predictions.compute_desired_mm("sharp-lag")
    return make_claim(
        "figure-10",
        trials,
        pictures=[Picture("The programmed path and its named places.", draw_path(desired, PLACES))],
    )


def _evaluate_feed_influence(place: str, number: int, little: bool) -> Claim:
    trials = []
    for name in PATHS:
        slow, fast = (
            path_predictions.find_largest_um(name, path_predictions.predict_path(name, p), place, p)
            for p in (SLOW, FAST)
        )
        bounds = {"most": LITTLE} if little else {"least": LITTLE}
        trials.append(Trial(name, f"largest error at {place}, 20 over 10 m/min", fast / slow, "x", **bounds))
    pictures = []
    for name in DRAWN if place == "A" else DRAWN[::2]:
        traced = [TracedPath("desired, 10 m/min", path_predictions.compute_desired_mm(name))]
        traced += [
            path_predictions.trace_prediction(p, name, path_predictions.predict_path(name, p), p) for p in (SLOW, FAST)
        ]
        pictures.append(Picture(
            f"Predicted path at {place} for two feeds, {PATHS[name].title}. The axes are stretched, as the paper's; "
            "below, the distance of each from its own desired path.",
            claim_drawings.draw_path_detail(traced, make_view(place, 10.0, 8.0)),
        ))  # fmt: skip
    ratios = [trial.value for trial in trials]
    return make_claim(f"figure-{number}", trials, pictures, least=min(ratios), most=max(ratios))


def make_view(place: str, half_mm: float, band_mm: float) -> View:
    """Return the drawn range of a place: centred on it, for A behind it."""
    x, y = PLACES[place]
    return View((x, x + 2 * half_mm) if place == "A" else (x - half_mm, x + half_mm), y, band_mm)


def _evaluate_error_size() -> Claim:
    trials = [
        Trial(
            name,
            "largest error at A, 10 m/min",
            path_predictions.find_largest_um(name, path_predictions.predict_path(name), "A"),
            "um",
            75.0,
            300.0,
        )
        for name in PATHS
    ]
    return make_claim("figure-11-size", trials)


def compute_distance_um(scenario: str, changes: Sequence[tuple[str, float]], program: str = SLOW) -> Float:
    """Return the distance (n,), um, between the paths with and without changed parameters of X."""
    one, other = (
        path_predictions.predict_path(scenario, program),
        path_predictions.predict_path(scenario, program, tuple(changes)),
    )
    return compute_contour_error_um(
        path_predictions.extract_path_mm(one), path_predictions.extract_path_mm(other), one.reference.dt_s
    )


def _find_largest_at_e(scenario: str, values: Float) -> float:
    return float(values[path_predictions.find_rows_near(path_predictions.predict_path(scenario), "E")].max())


def _evaluate_drift(number: int, changes: Sequence[tuple[str, float]], label: str) -> Claim:
    mass = changes is MASS
    trials = [
        Trial(name, "largest distance of the two paths at E",
              _find_largest_at_e(name, compute_distance_um(name, changes)), "um",
              **({"least": 10.0} if mass else {"least": 1.0, "most": 10.0}))
        for name in DEMANDED
    ]  # fmt: skip
    pictures = []
    for name in DRAWN:
        drifted = path_predictions.extract_path_mm(path_predictions.predict_path(name, SLOW, tuple(changes)))
        traced = [
            TracedPath("desired", path_predictions.compute_desired_mm(name)),
            TracedPath("nominal", path_predictions.extract_path_mm(path_predictions.predict_path(name))),
            TracedPath(
                "with an added mass" if mass else "with less friction", drifted, compute_distance_um(name, changes)
            ),
        ]
        pictures.append(Picture(
            f"Predicted path at E, 10 m/min, {PATHS[name].title}: nominal, and with {label}. Below, the distance of "
            "the two along X.",
            claim_drawings.draw_path_detail(traced, make_view("E", 5.0, 4.0), "distance (um)"),
        ))  # fmt: skip
    return make_claim(f"figure-{number}", trials, pictures)


def _compare_drift_with_feed() -> Claim:
    trials = []
    for name in DEMANDED:
        friction = _find_largest_at_e(name, compute_distance_um(name, FRICTION))
        feed = path_predictions.find_largest_um(
            name, path_predictions.predict_path(name, FAST), "E", FAST
        ) - path_predictions.find_largest_um(name, path_predictions.predict_path(name), "E")
        trials.append(Trial(name, "growth by the feed over the change by friction", feed / friction, "x", least=1.0))
    return make_claim("claim-drift-feed", trials)


def simulate_offset_response(scenario: str, answer: Prediction, offset_um: dict[str, Float]) -> dict[str, Float]:
    """Return the displacement (n,) of each axis, um, due to ``offset_um`` on the reference."""
    config = load_machine(scenario)
    moved = simulate_axes(
        build_nominal_models(config), config.axis, answer.reference.dt_s, answer.reference.position_mm,
        {axis: 1e-3 * values for axis, values in offset_um.items()},
    )  # fmt: skip
    return {axis: 1e3 * (response.table_mm - answer.predicted_mm[axis]) for axis, response in moved.items()}
