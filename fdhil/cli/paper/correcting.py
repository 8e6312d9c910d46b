"""Claims of section 6: equations [9] and [11], the mirror correction, figures 16 to 20."""

import numpy as np

from fdhil.cli.paper import drawings, paths
from fdhil.cli.paper.claims import Claim, Picture, Trial, make_claim
from fdhil.cli.paper.drawings import Traced, View
from fdhil.cli.paper.paths import CORNERS, PLACES
from fdhil.cli.paper.predicting import FEW_UM, linear_response
from fdhil.cli.paper.scenarios import DEMANDED, PATHS
from fdhil.records import Float, Prediction, compute_rms
from fdhil.report import Table

DRAWN = ("full", "half", "lag", "sharp-double-pi")
CUTTER_MM = 20.0
ROUNDED_END = (20.0, 75.0)  # of the arc at A, on the cutter's path
AROUND_MM = 20.0


def claims() -> list[Claim]:
    """Evaluate the claims of section 6."""
    return [
        _linear(),
        _ideal(),
        _mirror(),
        _oscillates(),
        _worse(),
        _straight("B", "figure-18"),
        _straight("F", "claim-f"),
        _arc(),
        _cutter_path(),
        _rounded(oscillation=False),
        _rounded(oscillation=True),
    ]


def _linear() -> Claim:
    trials = []
    for name in DEMANDED:
        answer = paths.predicted(name)
        whole = paths.offset_um(name, "mirror")
        full = linear_response(name, answer, whole)
        half = linear_response(name, answer, {axis: 0.5 * values for axis, values in whole.items()})
        missed = max(100.0 * compute_rms(2.0 * half[axis] - full[axis]) / compute_rms(full[axis]) for axis in whole)
        trials.append(Trial(name, "twice the answer to half an offset, less that to all of it", missed, "%", most=5.0))
    return make_claim("equation-9", trials)


def _ideal() -> Claim:
    trials = []
    for name in DEMANDED:
        before, after = (
            paths.rms_um(name, a) for a in (paths.predicted(name), paths.predict_paper_correction(name, "inverse"))
        )
        trials.append(Trial(name, "RMS left of the error", 100.0 * after / before, "%", most=10.0))
    return make_claim("equation-11", trials, tables=[_methods_table()])


def _methods_table() -> Table:
    rows = []
    for name in PATHS:
        for program in (paths.SLOW, paths.FAST):
            answers = [
                paths.predicted(name, program),
                *(paths.predict_paper_correction(name, m, program) for m in paths.METHODS),
            ]
            rows.append([name, program, *(f"{paths.rms_um(name, answer, program):.1f}" for answer in answers)])
    return Table(("scenario", "feed", "none", *paths.METHODS), rows, "RMS of the contour error, um")


def _mirror() -> Claim:
    trials, pictures = [], []
    for name in DEMANDED:
        before, after = (
            paths.rms_um(name, a) for a in (paths.predicted(name), paths.predict_paper_correction(name, "mirror"))
        )
        trials.append(Trial(name, "RMS error with the mirror over that without", after / before, "x", most=1.0))
        if name in DRAWN:
            answer, mirrored = paths.predicted(name), paths.predict_paper_correction(name, "mirror")
            rows = slice(*_rows_after_a(answer))
            pictures.append(Picture(
                f"Principle of the mirror on axis Y at A, 10 m/min, {PATHS[name].title}: the predicted error, the "
                "offset that is its mirror image, and the error that is left.",
                drawings.axis_errors(answer.reference.time_s[rows], {
                    "without": answer.error_um["Y"][rows], "offset": -answer.error_um["Y"][rows],
                    "with the mirror": mirrored.error_um["Y"][rows],
                }, "Y less reference (um)"),
            ))  # fmt: skip
    return make_claim("figure-16", trials, pictures=pictures, tables=[_places_table()])


def _rows_after_a(answer: Prediction) -> tuple[int, int]:
    row = int(np.argmin(np.hypot(*(answer.reference.path_mm - PLACES["A"]).T)))
    return row - 100, row + 400


def _places_table() -> Table:
    rows = []
    for name in PATHS:
        before, after = paths.predicted(name), paths.predict_paper_correction(name, "mirror")
        pairs = (f"{paths.largest_um(name, before, p):.0f} → {paths.largest_um(name, after, p):.0f}" for p in PLACES)
        rows.append([name, *pairs])
    return Table(
        ("scenario", *PLACES), rows, "Largest contour error near each place, um, without → with the mirror, 10 m/min"
    )


def turns(values: Float, least: float) -> int:
    """Return the number of changes between above ``least`` and below ``-least``."""
    sides = np.sign(values) * (np.abs(values) > least)
    sides = sides[sides != 0]
    return int(np.count_nonzero(np.diff(sides)))


def _three(scenario: str, view: View, program: str = paths.SLOW) -> str:
    before, after = paths.predicted(scenario, program), paths.predict_paper_correction(scenario, "mirror", program)
    return drawings.place(
        [
            Traced("desired", paths.desired_mm(scenario, program)),
            paths.traced("without", scenario, before, program),
            paths.traced("with the mirror", scenario, after, program),
        ],
        view,
    )


def _oscillates() -> Claim:
    trials, pictures = [], []
    for name in PATHS:
        before, after = paths.predicted(name), paths.predict_paper_correction(name, "mirror")
        then, now = (turns(a.error_um["Y"][slice(*_rows_after_a(a))], FEW_UM) for a in (before, after))
        trials += [
            Trial(name, f"changes of side beyond {FEW_UM:g} um behind A, with the mirror", float(now), "", least=2.0),
            Trial(name, "of these more than without", float(now - then), "", least=1.0),
        ]
        if name in DRAWN:
            pictures.append(Picture(
                f"Path in area A without and with the mirror correction, 10 m/min, {PATHS[name].title}. The axes are "
                "stretched, as the paper's; below, the contour errors.",
                _three(name, View((0.0, 25.0), 55.0, 4.0)),
            ))  # fmt: skip
    return make_claim("figure-17", trials, pictures=pictures)


def _worse() -> Claim:
    trials = []
    for name in PATHS:
        before, after = paths.predicted(name), paths.predict_paper_correction(name, "mirror")
        for place in CORNERS:
            ratio = paths.largest_um(name, after, place) / paths.largest_um(name, before, place)
            trials.append(Trial(name, f"largest error at {place}, with over without", ratio, "x", least=1.0))
    return make_claim("figure-17-worse", trials)


def _straight(place: str, key: str) -> Claim:
    trials, pictures = [], []
    for name in PATHS:
        after = paths.predict_paper_correction(name, "mirror")
        trials.append(Trial(name, f"largest error at {place}, with the mirror",
                            paths.largest_um(name, after, place), "um", most=FEW_UM))  # fmt: skip
        if name in DRAWN[::3] and place == "B":
            pictures.append(Picture(
                f"Path in area B without and with the mirror correction, 10 m/min, {PATHS[name].title}.",
                _three(name, View((30.0, 75.0), 55.0, 1.0, fine=True)),
            ))  # fmt: skip
    return make_claim(key, trials, pictures, limit_um=FEW_UM)


def _arc() -> Claim:
    trials = []
    for name in PATHS:
        before, after = (
            paths.largest_um(name, answer, "D")
            for answer in (paths.predicted(name), paths.predict_paper_correction(name, "mirror"))
        )
        trials += [
            Trial(name, "largest error at D, without", before, "um", 60.0, 150.0),
            Trial(name, "largest error at D, with the mirror", after, "um", 50.0, 90.0),
            Trial(name, "with over without", after / before, "x", most=1.0),
        ]
    return make_claim("claim-d", trials)


def _cutter_path() -> Claim:
    shape = paths.desired_mm("sharp-lag")
    trials = []
    for name in DEMANDED:
        centre = paths.reference(name, "rounded").path_mm - [CUTTER_MM, 0.0]
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
                drawings.shape(paths.reference("sharp-lag", "rounded").path_mm - [CUTTER_MM, 0.0], shape),
            )
        ],
    )


def _beside(answer: Prediction) -> Float:
    # lateral distance of the path from the reference at the end of the first arc, positive to the left
    reference = answer.reference.path_mm
    rows = np.flatnonzero(np.hypot(*(reference - ROUNDED_END).T) < AROUND_MM)
    error = paths.path_mm(answer) - reference
    along = np.gradient(reference, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.asarray(1e3 * (along[:, 0] * error[:, 1] - along[:, 1] * error[:, 0])[rows])


def _rounded(oscillation: bool) -> Claim:
    trials, pictures = [], []
    for name in DEMANDED:
        before, after = paths.predicted(name, "rounded"), paths.predict_paper_correction(name, "mirror", "rounded")
        one, other = _beside(before), _beside(after)
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
                _three(name, View((5.0, 45.0), 75.0, 4.0), "rounded"),
            ))  # fmt: skip
    return make_claim("figure-20-oscillation" if oscillation else "figure-20", trials, pictures)
