"""Section 6 of the paper: equations [9] and [11], the mirror, and figures 16 to 20."""

import numpy as np

from fdhil.cli.paper import drawings, paths
from fdhil.cli.paper.claims import Claim, Picture, Trial
from fdhil.cli.paper.drawings import Traced, View
from fdhil.cli.paper.paths import CORNERS, PLACES
from fdhil.cli.paper.predicting import FEW_UM, linear_response
from fdhil.cli.paper.scenarios import DEMANDED, PATHS
from fdhil.records import Float, Prediction, rms
from fdhil.report import Table

DRAWN = ("full", "half", "lag", "sharp-double-pi")
CUTTER_MM = 20.0
ROUNDED_END = (20.0, 75.0)  # of the arc at A, on the cutter's path
AROUND_MM = 20.0


def claims() -> list[Claim]:
    """Return the claims of section 6."""
    return [
        _linear(),
        _ideal(),
        _mirror(),
        _oscillates(),
        _worse(),
        _straight("B", "figure-18", "Figure 18, section 6"),
        _straight("F", "claim-f", "Section 6"),
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
        missed = max(100.0 * rms(2.0 * half[axis] - full[axis]) / rms(full[axis]) for axis in whole)
        trials.append(Trial(name, "twice the answer to half an offset, less that to all of it", missed, "%", most=5.0))
    return Claim(
        key="equation-9", title="the drive is a transfer function",
        kind="equation", source="Equation [9], section 6",
        says="The predicted positions follow from the reference by a transfer function: pp = Hr pr.",
        paper="no figures are given",
        rule="half an offset moves the table half as far, to 5 % (RMS)",
        trials=trials,
        note="Dry friction and the limits of current and voltage are in no transfer function; after a sharp corner the "
             "limits rule.",
    )  # fmt: skip


def _ideal() -> Claim:
    trials = []
    for name in DEMANDED:
        before, after = (paths.rms_um(name, a) for a in (paths.predicted(name), paths.corrected(name, "inverse")))
        trials.append(Trial(name, "RMS left of the error", 100.0 * after / before, "%", most=10.0))
    return Claim(
        key="equation-11", title="the ideal correction",
        kind="equation", source="Equation [11], section 6",
        says="pr = Hr (pr - Hr^-1 e): with the inverse of Hr the table would follow the reference; it cannot be easily "
             "calculated.",
        paper="not tried",
        rule="the inverse of the simulated loop, applied once, leaves at most 10 % (RMS) of the contour error",
        trials=trials,
        tables=[_methods_table()],
        note="The inverse is that of the loop's answer to an impulse, regularised, without delay, up to 120 Hz. What "
             "fdhil sends on a machine goes on from there, with friction and within limits.",
    )  # fmt: skip


def _methods_table() -> Table:
    rows = []
    for name in PATHS:
        for program in (paths.SLOW, paths.FAST):
            answers = [paths.predicted(name, program), *(paths.corrected(name, m, program) for m in paths.METHODS)]
            rows.append([name, program, *(f"{paths.rms_um(name, answer, program):.1f}" for answer in answers)])
    return Table(("scenario", "feed", "none", *paths.METHODS), rows, "RMS of the contour error, um")


def _mirror() -> Claim:
    trials, pictures = [], []
    for name in DEMANDED:
        before, after = (paths.rms_um(name, a) for a in (paths.predicted(name), paths.corrected(name, "mirror")))
        trials.append(Trial(name, "RMS error with the mirror over that without", after / before, "x", most=1.0))
        if name in DRAWN:
            answer, mirrored = paths.predicted(name), paths.corrected(name, "mirror")
            rows = slice(*_rows_after_a(answer))
            pictures.append(Picture(
                f"Principle of the mirror on axis Y at A, 10 m/min, {PATHS[name].title}: the predicted error, the "
                "offset that is its mirror image, and the error that is left.",
                drawings.axis_errors(answer.reference.time_s[rows], {
                    "without": answer.error_um["Y"][rows], "offset": -answer.error_um["Y"][rows],
                    "with the mirror": mirrored.error_um["Y"][rows],
                }, "Y less reference (um)"),
            ))  # fmt: skip
    return Claim(
        key="figure-16", title="the mirror makes the error smaller",
        kind="figure", source="Figure 16, section 6",
        says="With Hr^-1 ~ 1 the correction becomes a mirror: the predicted errors are subtracted from the reference.",
        paper="a scheme; \"quite good results for smooth trajectories\"",
        rule="the mirror makes the contour error of the whole path smaller (RMS)",
        trials=trials, pictures=pictures,
        tables=[_places_table()],
    )  # fmt: skip


def _rows_after_a(answer: Prediction) -> tuple[int, int]:
    row = int(np.argmin(np.hypot(*(answer.reference.path_mm - PLACES["A"]).T)))
    return row - 100, row + 400


def _places_table() -> Table:
    rows = []
    for name in PATHS:
        before, after = paths.predicted(name), paths.corrected(name, "mirror")
        pairs = (f"{paths.largest_um(name, before, p):.0f} → {paths.largest_um(name, after, p):.0f}" for p in PLACES)
        rows.append([name, *pairs])
    return Table(
        ("scenario", *PLACES), rows, "Largest contour error near each place, um, without → with the mirror, 10 m/min"
    )


def turns(values: Float, least: float) -> int:
    """Return how often a signal goes from above ``least`` to below ``-least`` or back."""
    sides = np.sign(values) * (np.abs(values) > least)
    sides = sides[sides != 0]
    return int(np.count_nonzero(np.diff(sides)))


def _three(scenario: str, view: View, program: str = paths.SLOW) -> str:
    before, after = paths.predicted(scenario, program), paths.corrected(scenario, "mirror", program)
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
        before, after = paths.predicted(name), paths.corrected(name, "mirror")
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
    return Claim(
        key="figure-17", title="the mirror oscillates at A",
        kind="figure", source="Figure 17, section 6",
        says="With the mirror the position oscillates around the desired path in A.",
        paper="Y 54.4 to 55.4 mm behind A: 0.6 mm at most",
        rule="behind A the error in Y changes sides twice or more with the mirror, and more often than without",
        trials=trials, pictures=pictures,
        note="P, PI and PI with the bench's gains are damped too well to swing; a double PI is not.",
    )  # fmt: skip


def _worse() -> Claim:
    trials = []
    for name in PATHS:
        before, after = paths.predicted(name), paths.corrected(name, "mirror")
        for place in CORNERS:
            ratio = paths.largest_um(name, after, place) / paths.largest_um(name, before, place)
            trials.append(Trial(name, f"largest error at {place}, with over without", ratio, "x", least=1.0))
    return Claim(
        key="figure-17-worse", title="the mirror is worse in corners",
        kind="figure", source="Figure 17, section 6",
        says="In the areas A, C, E and G the correction generates more inaccuracy on the followed shape.",
        paper="0.6 mm at most with, 0.15 to 0.2 mm without (Figure 11)",
        rule="the largest error near each of the four is larger with the mirror than without",
        trials=trials,
    )  # fmt: skip


def _straight(place: str, key: str, source: str) -> Claim:
    trials, pictures = [], []
    for name in PATHS:
        after = paths.corrected(name, "mirror")
        trials.append(Trial(name, f"largest error at {place}, with the mirror",
                            paths.largest_um(name, after, place), "um", most=FEW_UM))  # fmt: skip
        if name in DRAWN[::3] and place == "B":
            pictures.append(Picture(
                f"Path in area B without and with the mirror correction, 10 m/min, {PATHS[name].title}.",
                _three(name, View((30.0, 75.0), 55.0, 1.0, fine=True)),
            ))  # fmt: skip
    return Claim(
        key=key, title=f"the mirror on the straight at {place}",
        kind="figure" if place == "B" else "claim", source=source,
        says=f"With the mirror the obtained path is only few micrometres from the desired one in {place}.",
        paper="a few um" + ("; Y 54.996 to 55.001 mm" if place == "B" else ""),
        rule=f"at most {FEW_UM:g} um within 10 mm of {place}",
        trials=trials, pictures=pictures,
    )  # fmt: skip


def _arc() -> Claim:
    trials = []
    for name in PATHS:
        before, after = (
            paths.largest_um(name, answer, "D") for answer in (paths.predicted(name), paths.corrected(name, "mirror"))
        )
        trials += [
            Trial(name, "largest error at D, without", before, "um", 60.0, 150.0),
            Trial(name, "largest error at D, with the mirror", after, "um", 50.0, 90.0),
            Trial(name, "with over without", after / before, "x", most=1.0),
        ]
    return Claim(
        key="claim-d", title="the mirror in the arc at D",
        kind="claim", source="Section 6",
        says="In D the difference between obtained and desired path is 0.07 mm, compared to 0.08 mm and 0.13 mm.",
        paper="80 and 130 um without, 70 um with the mirror",
        rule="60 to 150 um without, 50 to 90 um with, and less with than without, 10 m/min",
        trials=trials,
    )  # fmt: skip


def _cutter_path() -> Claim:
    shape = paths.desired_mm("sharp-lag")
    trials = []
    for name in DEMANDED:
        centre = paths.reference(name, "rounded").path_mm - [CUTTER_MM, 0.0]
        inside = (centre[:, 1] > 5.0) & (centre[:, 0] < PLACES["G"][0] - CUTTER_MM - 5.0)
        gaps = [float(np.hypot(*(shape - point).T).min()) for point in centre[inside][::20]]
        worst = float(np.abs(np.array(gaps) - CUTTER_MM).max())
        trials.append(Trial(name, "farthest from 20 mm beside the shape", worst, "mm", most=0.1))
    return Claim(
        key="figure-19", title="the path of the cutter",
        kind="figure", source="Figure 19, section 6",
        says="The path of the centre of a 40 mm cutter round the shape, with arcs of 20 mm at A, C and E.",
        paper="a figure",
        rule="the demand runs 20 mm beside the shape, to 0.1 mm",
        trials=trials,
        pictures=[Picture(
            "The path of the cutter's centre, 20 mm beside the shape that it cuts.",
            drawings.shape(paths.reference("sharp-lag", "rounded").path_mm - [CUTTER_MM, 0.0], shape),
        )],
    )  # fmt: skip


def _beside(answer: Prediction) -> Float:
    """Return how far the path is beside the reference around the end of the first arc, um, positive to the left."""
    reference = answer.reference.path_mm
    rows = np.flatnonzero(np.hypot(*(reference - ROUNDED_END).T) < AROUND_MM)
    error = paths.path_mm(answer) - reference
    along = np.gradient(reference, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.asarray(1e3 * (along[:, 0] * error[:, 1] - along[:, 1] * error[:, 0])[rows])


def _rounded(oscillation: bool) -> Claim:
    trials, pictures = [], []
    for name in DEMANDED:
        before, after = paths.predicted(name, "rounded"), paths.corrected(name, "mirror", "rounded")
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
    return Claim(
        key="figure-20-oscillation" if oscillation else "figure-20",
        title="oscillation on the rounded path" if oscillation else "mean error on the rounded path",
        kind="figure", source="Figure 20, section 6",
        says="On the rounded path the oscillations with the correction are more important." if oscillation else
             "On the rounded path the mean trajectory with the correction is far better than without.",
        paper="Y 74.6 to 75.3 mm, on both sides of 75 with the correction",
        rule="within 20 mm of the arc's end the error's standard deviation is larger with the mirror" if oscillation
             else "within 20 mm of the arc's end the mean error is at least halved",
        trials=trials, pictures=pictures,
    )  # fmt: skip
