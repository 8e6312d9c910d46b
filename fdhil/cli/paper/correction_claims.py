"""Claims of section 6: equations [9] and [11], the mirror correction, figures 16 to 20."""

import numpy as np

from fdhil.cli.paper import claim_drawings, path_predictions
from fdhil.cli.paper.claim_drawings import TracedPath, View
from fdhil.cli.paper.claims import Claim, Picture, Trial, make_claim
from fdhil.cli.paper.path_predictions import CORNERS, PLACES
from fdhil.cli.paper.prediction_claims import FEW_UM, simulate_offset_response
from fdhil.cli.paper.scenarios import DEMANDED, PATHS
from fdhil.records import Float, Prediction, compute_rms
from fdhil.report import Table

DRAWN = ("full", "half", "lag", "sharp-double-pi")
CUTTER_MM = 20.0
ROUNDED_END = (20.0, 75.0)  # of the arc at A, on the cutter's path
AROUND_MM = 20.0


def evaluate_claims() -> list[Claim]:
    """Evaluate the claims of section 6."""
    return [
        _evaluate_linearity(),
        _evaluate_ideal_correction(),
        _evaluate_mirror(),
        _evaluate_oscillation(),
        _evaluate_corners(),
        _evaluate_straight("B", "figure-18"),
        _evaluate_straight("F", "claim-f"),
        _evaluate_arc(),
        _evaluate_cutter_path(),
        _evaluate_rounded_path(oscillation=False),
        _evaluate_rounded_path(oscillation=True),
    ]


def _evaluate_linearity() -> Claim:
    trials = []
    for name in DEMANDED:
        answer = path_predictions.predict_path(name)
        whole = path_predictions.compute_offset_um(name, "mirror")
        full = simulate_offset_response(name, answer, whole)
        half = simulate_offset_response(name, answer, {axis: 0.5 * values for axis, values in whole.items()})
        missed = max(100.0 * compute_rms(2.0 * half[axis] - full[axis]) / compute_rms(full[axis]) for axis in whole)
        trials.append(Trial(name, "twice the answer to half an offset, less that to all of it", missed, "%", most=5.0))
    return make_claim("equation-9", trials)


def _evaluate_ideal_correction() -> Claim:
    trials = []
    for name in DEMANDED:
        before, after = (
            path_predictions.compute_rms_um(name, a)
            for a in (path_predictions.predict_path(name), path_predictions.predict_paper_correction(name, "inverse"))
        )
        trials.append(Trial(name, "RMS left of the error", 100.0 * after / before, "%", most=10.0))
    return make_claim("equation-11", trials, tables=[_build_methods_table()])


def _build_methods_table() -> Table:
    rows = []
    for name in PATHS:
        for program in (path_predictions.SLOW, path_predictions.FAST):
            answers = [
                path_predictions.predict_path(name, program),
                *(path_predictions.predict_paper_correction(name, m, program) for m in path_predictions.METHODS),
            ]
            rows.append(
                [
                    name,
                    program,
                    *(f"{path_predictions.compute_rms_um(name, answer, program):.1f}" for answer in answers),
                ]
            )
    return Table(("scenario", "feed", "none", *path_predictions.METHODS), rows, "RMS of the contour error, um")


def _evaluate_mirror() -> Claim:
    trials, pictures = [], []
    for name in DEMANDED:
        before, after = (
            path_predictions.compute_rms_um(name, a)
            for a in (path_predictions.predict_path(name), path_predictions.predict_paper_correction(name, "mirror"))
        )
        trials.append(Trial(name, "RMS error with the mirror over that without", after / before, "x", most=1.0))
        if name in DRAWN:
            answer, mirrored = (
                path_predictions.predict_path(name),
                path_predictions.predict_paper_correction(name, "mirror"),
            )
            rows = slice(*_find_rows_after_a(answer))
            pictures.append(Picture(
                f"Principle of the mirror on axis Y at A, 10 m/min, {PATHS[name].title}: the predicted error, the "
                "offset that is its mirror image, and the error that is left.",
                claim_drawings.draw_axis_errors(answer.reference.time_s[rows], {
                    "without": answer.error_um["Y"][rows], "offset": -answer.error_um["Y"][rows],
                    "with the mirror": mirrored.error_um["Y"][rows],
                }, "Y less reference (um)"),
            ))  # fmt: skip
    return make_claim("figure-16", trials, pictures=pictures, tables=[_build_places_table()])


def _find_rows_after_a(answer: Prediction) -> tuple[int, int]:
    row = int(np.argmin(np.hypot(*(answer.reference.path_mm - PLACES["A"]).T)))
    return row - 100, row + 400


def _build_places_table() -> Table:
    rows = []
    for name in PATHS:
        before, after = path_predictions.predict_path(name), path_predictions.predict_paper_correction(name, "mirror")
        pairs = (
            f"{path_predictions.find_largest_um(name, before, p):.0f} → "
            f"{path_predictions.find_largest_um(name, after, p):.0f}"
            for p in PLACES
        )
        rows.append([name, *pairs])
    return Table(
        ("scenario", *PLACES), rows, "Largest contour error near each place, um, without → with the mirror, 10 m/min"
    )


def count_sign_changes(values: Float, least: float) -> int:
    """Return the number of changes between above ``least`` and below ``-least``."""
    sides = np.sign(values) * (np.abs(values) > least)
    sides = sides[sides != 0]
    return int(np.count_nonzero(np.diff(sides)))


def _draw_comparison(scenario: str, view: View, program: str = path_predictions.SLOW) -> str:
    before, after = (
        path_predictions.predict_path(scenario, program),
        path_predictions.predict_paper_correction(scenario, "mirror", program),
    )
    return claim_drawings.draw_path_detail(
        [
            TracedPath("desired", path_predictions.compute_desired_mm(scenario, program)),
            path_predictions.trace_prediction("without", scenario, before, program),
            path_predictions.trace_prediction("with the mirror", scenario, after, program),
        ],
        view,
    )


def _evaluate_oscillation() -> Claim:
    trials, pictures = [], []
    for name in PATHS:
        before, after = path_predictions.predict_path(name), path_predictions.predict_paper_correction(name, "mirror")
        then, now = (
            count_sign_changes(a.error_um["Y"][slice(*_find_rows_after_a(a))], FEW_UM) for a in (before, after)
        )
        trials += [
            Trial(name, f"changes of side beyond {FEW_UM:g} um behind A, with the mirror", float(now), "", least=2.0),
            Trial(name, "of these more than without", float(now - then), "", least=1.0),
        ]
        if name in DRAWN:
            pictures.append(Picture(
                f"Path in area A without and with the mirror correction, 10 m/min, {PATHS[name].title}. The axes are "
                "stretched, as the paper's; below, the contour errors.",
                _draw_comparison(name, View((0.0, 25.0), 55.0, 4.0)),
            ))  # fmt: skip
    return make_claim("figure-17", trials, pictures=pictures)


def _evaluate_corners() -> Claim:
    trials = []
    for name in PATHS:
        before, after = path_predictions.predict_path(name), path_predictions.predict_paper_correction(name, "mirror")
        for place in CORNERS:
            ratio = path_predictions.find_largest_um(name, after, place) / path_predictions.find_largest_um(
                name, before, place
            )
            trials.append(Trial(name, f"largest error at {place}, with over without", ratio, "x", least=1.0))
    return make_claim("figure-17-worse", trials)


def _evaluate_straight(place: str, key: str) -> Claim:
    trials, pictures = [], []
    for name in PATHS:
        after = path_predictions.predict_paper_correction(name, "mirror")
        trials.append(Trial(name, f"largest error at {place}, with the mirror",
                            path_predictions.find_largest_um(name, after, place), "um", most=FEW_UM))  # fmt: skip
        if name in DRAWN[::3] and place == "B":
            pictures.append(Picture(
                f"Path in area B without and with the mirror correction, 10 m/min, {PATHS[name].title}.",
                _draw_comparison(name, View((30.0, 75.0), 55.0, 1.0, fine=True)),
            ))  # fmt: skip
    return make_claim(key, trials, pictures, limit_um=FEW_UM)


def _evaluate_arc() -> Claim:
    trials = []
    for name in PATHS:
        before, after = (
            path_predictions.find_largest_um(name, answer, "D")
            for answer in (
                path_predictions.predict_path(name),
                path_predictions.predict_paper_correction(name, "mirror"),
            )
        )
        trials += [
            Trial(name, "largest error at D, without", before, "um", 60.0, 150.0),
            Trial(name, "largest error at D, with the mirror", after, "um", 50.0, 90.0),
            Trial(name, "with over without", after / before, "x", most=1.0),
        ]
    return make_claim("claim-d", trials)


def _evaluate_cutter_path() -> Claim:
    shape = path_predictions.compute_desired_mm("sharp-lag")
    trials = []
    for name in DEMANDED:
        centre = path_predictions.load_reference(name, "rounded").path_mm - [CUTTER_MM, 0.0]
        inside = (centre[:, 1] > 5.0) & (centre[:, 0] < PLACES["G"][0] - CUTTER_MM - 5.0)
        gaps = [float(np.hypot(*(shape - point).T).min()) for point in centre[inside][::20]]
        worst = float(np.abs(np.array(gaps) - CUTTER_MM).max())
        trials.append(Trial(name, "farthest from 20 mm beside the shape", worst, "mm", most=0.1))
    return make_claim(
        "figure-19",
        trials,
        pictures=[
            Picture(
                "The path of the cutter's centre, 20 mm beside the shape that it cuts.",
                claim_drawings.draw_cutter_path(
                    path_predictions.load_reference("sharp-lag", "rounded").path_mm - [CUTTER_MM, 0.0], shape
                ),
            )
        ],
    )


def _compute_lateral_error_um(answer: Prediction) -> Float:
    # lateral distance of the path from the reference at the end of the first arc, positive to the left
    reference = answer.reference.path_mm
    rows = np.flatnonzero(np.hypot(*(reference - ROUNDED_END).T) < AROUND_MM)
    error = path_predictions.extract_path_mm(answer) - reference
    along = np.gradient(reference, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.asarray(1e3 * (along[:, 0] * error[:, 1] - along[:, 1] * error[:, 0])[rows])


def _evaluate_rounded_path(oscillation: bool) -> Claim:
    trials, pictures = [], []
    for name in DEMANDED:
        before, after = (
            path_predictions.predict_path(name, "rounded"),
            path_predictions.predict_paper_correction(name, "mirror", "rounded"),
        )
        one, other = _compute_lateral_error_um(before), _compute_lateral_error_um(after)
        if oscillation:
            trials.append(Trial(name, "standard deviation with the mirror over that without",
                                float(np.std(other) / np.std(one)), "x", least=1.0))  # fmt: skip
            continue
        means = abs(float(one.mean())) / max(abs(float(other.mean())), 1e-9)
        trials.append(Trial(name, "mean error without over that with the mirror", means, "x", least=2.0))
        if name in DRAWN:
            pictures.append(Picture(
                f"Path of the cutter's centre at the end of the arc at A without and with the mirror, 10 m/min, "
                f"{PATHS[name].title}.",
                _draw_comparison(name, View((5.0, 45.0), 75.0, 4.0), "rounded"),
            ))  # fmt: skip
    return make_claim("figure-20-oscillation" if oscillation else "figure-20", trials, pictures)
