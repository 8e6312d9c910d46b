"""Section 5 of the paper: figures 9 to 15, where errors arise, and what the feed, friction, a mass and cutting do."""

from collections.abc import Sequence

import numpy as np

from fdhil.cli.paper import bench, drawings, paths
from fdhil.cli.paper.bench import Move
from fdhil.cli.paper.claims import Claim, Picture, Trial
from fdhil.cli.paper.drawings import Traced, View
from fdhil.cli.paper.paths import CORNERS, FAST, PLACES, SLOW, SMOOTH
from fdhil.cli.paper.scenarios import CASCADES, DEMANDED, PATHS, machine
from fdhil.config import Identification
from fdhil.identification.estimators import maximum_likelihood
from fdhil.model import closed_loop
from fdhil.prediction import contour_error_um, predict
from fdhil.prediction.models import nominal_models
from fdhil.records import Float, Parameters, Prediction, rms
from fdhil.report import Table, figures

DRAWN = ("full", "half", "sharp-lag")  # the loops whose paths are drawn
LITTLE = 1.25  # the larger feed raises an error by less than a quarter
FRICTION = (("ft", 0.01), ("Cd", 1.0))
MASS = (("Jt", 0.085),)
FEW_UM = 5.0
SLOW_SHARE = 0.4


def claims() -> list[Claim]:
    """Return the claims of section 5."""
    return [
        _structure(),
        _abrupt(),
        _feed_down(),
        _prediction(),
        _cutting(),
        _path(),
        _feeds("A", 11, little=True),
        _size(),
        _feeds("C", 12, little=False),
        _feeds("E", 13, little=False),
        _drifted(14, FRICTION, "ft 0.05 to 0.01 N.m.s and Cd 5 to 1 N.m on X"),
        _less_than_feed(),
        _drifted(15, MASS, "Jt 0.075 to 0.085 kg.m2 on X"),
    ]


def _structure() -> Claim:
    trials = []
    for name in CASCADES:
        missed = np.abs(paths.measured_mm(name) - paths.path_mm(paths.predicted(name))).max()
        trials.append(Trial(name, "largest difference of the two", 1e3 * float(missed), "um", most=5.0))
    return Claim(
        key="equation-1-2", title="the model of a feed drive",
        kind="equation", source="Equations [1] and [2], Figure 1, section 1",
        says="u - K w = L di/dt + R i; K i - Tl = Jt dw/dt + ft w + Cd sign(w); with position, speed and current "
             "regulators they are the model of a feed-drive.",
        paper="a scheme",
        rule="two programs for these equations, one stepped every 31.25 us with encoder counts, one without, are at "
             "most 5 um apart on the whole path",
        trials=trials,
    )  # fmt: skip


def _abrupt() -> Claim:
    trials, rows = [], []
    for name in PATHS:
        answer = paths.predicted(name)
        found = {place: paths.largest_um(name, answer, place) for place in PLACES}
        ratio = min(found[place] for place in CORNERS) / max(found[place] for place in SMOOTH)
        trials.append(Trial(name, "least of A, C, E, G over the largest of B, D, F", ratio, "x", least=2.0))
        rows.append([name, *(f"{found[place]:.0f}" for place in PLACES)])
    return Claim(
        key="claim-abrupt", title="errors arise at abrupt changes",
        kind="claim", source="Section 5.1",
        says="Path shortcomings become significant where abrupt changes of direction or interpolation happen.",
        paper="no figures are given",
        rule="within 10 mm of each corner the error is at least twice that on straights and arc, 10 m/min",
        trials=trials,
        tables=[Table(("scenario", *PLACES), rows, "Largest contour error near each place, um, 10 m/min")],
    )  # fmt: skip


def _feed_down() -> Claim:
    trials = []
    for name in PATHS:
        slow, fast = (paths.rms_um(name, paths.predicted(name, p), p) for p in (SLOW, FAST))
        times = [paths.reference(name, p).time_s[-1] for p in (SLOW, FAST)]
        trials += [
            Trial(name, "RMS error at 20 over that at 10 m/min", fast / slow, "x", least=1.05),
            Trial(name, "time at 10 over that at 20 m/min", float(times[0] / times[1]), "x", least=1.5),
        ]
    return Claim(
        key="claim-feed", title="a lower feed errs less and takes longer",
        kind="claim", source="Section 5.1 and conclusion",
        says="If the feed rate is reduced the shortcomings decrease, and the manufacturing time increases.",
        paper="no figures are given",
        rule="the RMS error grows and the time shrinks from 10 to 20 m/min",
        trials=trials,
    )  # fmt: skip


def identified() -> Parameters:
    """Identify the simulator's drive from a fast and a slow rapid each way, noise of 0.1 %."""
    true = nominal_models(machine())["X"]
    recordings = [bench.rapid(true, strokes=2, move=Move.measured(share)) for share in (1.0, SLOW_SHARE)]
    windows = [window for k, one in enumerate(recordings) for window in bench.noisy(one, 0.001, k)]
    return maximum_likelihood.estimate(windows, Identification()).parameters()


def _prediction() -> Claim:
    model = identified()
    trials, pictures = [], []
    for name in CASCADES:
        config, reference = machine(name), paths.reference(name)
        measured = contour_error_um(reference.path_mm, paths.measured_mm(name), reference.dt_s)
        told = predict(reference, {"X": model, "Y": model}, config).contour_um
        missed = 100.0 * rms(told - measured) / rms(measured)
        trials.append(Trial(name, "RMS between predicted and measured, of the measured", missed, "%", most=10.0))
        if name in DRAWN:
            pictures.append(Picture(
                f"Contour error along the path at 10 m/min, {PATHS[name].title}: predicted from identified parameters "
                "and as the simulated machine has it; below, what is between them.",
                drawings.overlay(reference.time_s, "time (s)", "contour error (um)",
                                 [("machine", measured), ("predicted", told)]),
            ))  # fmt: skip
    return Claim(
        key="figure-9", title="the shortcomings are predicted",
        kind="figure", source="Figure 9 and equation [10], section 5.2",
        says="Parameters from rapids, put into the closed loops and run along the reference, predict the shortcomings "
             "e = pp - pr before the cut.",
        paper="a scheme",
        rule="predicted and measured contour error at most 10 % (RMS) apart",
        trials=trials, pictures=pictures,
    )  # fmt: skip


def _cutting() -> Claim:
    config = machine("full")
    axis, true = config.axis["X"], nominal_models(config)["X"]
    demand = SLOW_MM_S * np.arange(0.0, 1.0, config.machine.sync_period_s)
    free = bench.run(axis, config.machine.sync_period_s, true, demand).table_mm
    trials = []
    for name, newton in (("force-30", 30.0), ("force-300", 300.0), ("force-3000", 3000.0)):
        load = np.where(np.arange(demand.size) < demand.size // 2, 0.0, newton * axis.screw_pitch_mm / 2e3 / np.pi)
        moved = bench.run(axis, config.machine.sync_period_s, true, demand, load).table_mm - free
        trials.append(Trial(name, "table moved by the force", 1e3 * float(np.abs(moved).max()), "um", most=FEW_UM))
    return Claim(
        key="claim-cutting", title="cutting forces can be neglected",
        kind="claim", source="Section 5.2",
        says="The effect of the cutting forces of high-speed machining of aluminium and of finishing can be neglected: "
             "Tl = 0.",
        paper="no figures are given",
        rule=f"a force that sets in at once moves the table by at most {FEW_UM:g} um",
        trials=trials,
    )  # fmt: skip


SLOW_MM_S = 10e3 / 60


def _path() -> Claim:
    trials = []
    for name in DEMANDED:
        missed = max(float(np.hypot(*(paths.reference(name).path_mm - place).T).min()) for place in PLACES.values())
        trials.append(Trial(name, "farthest of the places from the demand", missed, "mm", most=0.1))
    desired = paths.desired_mm("sharp-lag")
    return Claim(
        key="figure-10", title="the programmed path",
        kind="figure", source="Figure 10, section 5.3",
        says="The tool is asked to follow this planar path, with areas A to G.",
        paper="(0, 0), A (0, 55), C (100, 55), arc through D, E (200, 55), G (250, 55), (250, 0) mm",
        rule="the NC's demand at 10 m/min comes within 0.1 mm of each place",
        trials=trials,
        pictures=[Picture("The programmed path and its named places.", figures.path(desired, PLACES))],
        note="An NC that smooths each axis rounds the corners by itself, by more than its drives err: errors are told "
             "against its demand and, in the scenarios -programmed, against the programmed path.",
    )  # fmt: skip


def _feeds(place: str, number: int, little: bool) -> Claim:
    trials = []
    for name in PATHS:
        slow, fast = (paths.largest_um(name, paths.predicted(name, p), place, p) for p in (SLOW, FAST))
        bounds = {"most": LITTLE} if little else {"least": LITTLE}
        trials.append(Trial(name, f"largest error at {place}, 20 over 10 m/min", fast / slow, "x", **bounds))
    says = (
        "In A the errors are mainly due to the control laws: the feed matters little."
        if little
        else f"In {place} the influence of the feed rate is significant."
    )
    pictures = []
    for name in DRAWN if place == "A" else DRAWN[::2]:
        traced = [Traced("desired, 10 m/min", paths.desired_mm(name))]
        traced += [paths.traced(p, name, paths.predicted(name, p), p) for p in (SLOW, FAST)]
        pictures.append(Picture(
            f"Predicted path at {place} for two feeds, {PATHS[name].title}. The axes are stretched, as the paper's; "
            "below, the distance of each from its own desired path.",
            drawings.place(traced, view(place, 10.0, 8.0)),
        ))  # fmt: skip
    ratios = [trial.value for trial in trials]
    return Claim(
        key=f"figure-{number}", title=f"the feed matters {'little' if little else 'much'} at {place}",
        kind="figure", source=f"Figure {number}, section 5.3",
        says=says,
        paper="two curves of like size" if little else "the faster one clearly farther off",
        rule=f"the largest error grows by {'less' if little else 'more'} than a quarter from 10 to 20 m/min",
        trials=trials, pictures=pictures,
        note=f"Here the larger feed makes the error at {place} {min(ratios):.1f} to {max(ratios):.1f} times as large.",
    )  # fmt: skip


def view(place: str, half_mm: float, band_mm: float) -> View:
    """Return what is drawn of a place: as much before it as behind, at A all behind."""
    x, y = PLACES[place]
    return View((x, x + 2 * half_mm) if place == "A" else (x - half_mm, x + half_mm), y, band_mm)


def _size() -> Claim:
    trials = [
        Trial(
            name, "largest error at A, 10 m/min", paths.largest_um(name, paths.predicted(name), "A"), "um", 75.0, 300.0
        )
        for name in PATHS
    ]
    return Claim(
        key="figure-11-size", title="the size of the error at A",
        kind="figure", source="Figure 11, section 5.3",
        says="Behind A the table runs over by 0.15 to 0.2 mm.",
        paper="Y 55.15 to 55.2 mm beside 55, read from the figure",
        rule="75 to 300 um",
        trials=trials,
        note="The paper does not tell its regulators' gains nor its NC's corners, which decide this.",
    )  # fmt: skip


def apart_um(scenario: str, changes: Sequence[tuple[str, float]], program: str = SLOW) -> Float:
    """Return the distance (n,) of the path with changed parameters of X from the one without."""
    one, other = paths.predicted(scenario, program), paths.predicted(scenario, program, tuple(changes))
    return contour_error_um(paths.path_mm(one), paths.path_mm(other), one.reference.dt_s)


def _at_e(scenario: str, values: Float) -> float:
    return float(values[paths.near(paths.predicted(scenario), "E")].max())


def _drifted(number: int, changes: Sequence[tuple[str, float]], label: str) -> Claim:
    mass = changes is MASS
    trials = [
        Trial(name, "largest distance of the two paths at E", _at_e(name, apart_um(name, changes)), "um",
              **({"least": 10.0} if mass else {"least": 1.0, "most": 10.0}))
        for name in DEMANDED
    ]  # fmt: skip
    pictures = []
    for name in DRAWN:
        drifted = paths.path_mm(paths.predicted(name, SLOW, tuple(changes)))
        traced = [
            Traced("desired", paths.desired_mm(name)),
            Traced("nominal", paths.path_mm(paths.predicted(name))),
            Traced("with an added mass" if mass else "with less friction", drifted, apart_um(name, changes)),
        ]
        pictures.append(Picture(
            f"Predicted path at E, 10 m/min, {PATHS[name].title}: nominal, and with {label}. Below, the distance of "
            "the two along X.",
            drawings.place(traced, view("E", 5.0, 4.0), "distance (um)"),
        ))  # fmt: skip
    return Claim(
        key=f"figure-{number}",
        title="an added mass moves the path" if mass else "friction's drift moves the path little",
        kind="figure", source=f"Figure {number}, section 5.3",
        says="An added mass moves the path by more than 0.01 mm." if mass else
             "A drift of ft and Cd of one axis moves the path by a few micrometres only.",
        paper="more than 10 um at E" if mass else "a few um at E",
        rule="at least 10 um between the two paths within 10 mm of E" if mass else
             "1 to 10 um between the two paths within 10 mm of E",
        trials=trials, pictures=pictures,
    )  # fmt: skip


def _less_than_feed() -> Claim:
    trials = []
    for name in DEMANDED:
        friction = _at_e(name, apart_um(name, FRICTION))
        feed = paths.largest_um(name, paths.predicted(name, FAST), "E", FAST) - paths.largest_um(
            name, paths.predicted(name), "E"
        )
        trials.append(Trial(name, "growth by the feed over the change by friction", feed / friction, "x", least=1.0))
    return Claim(
        key="claim-drift-feed", title="drifts matter less than the feed",
        kind="claim", source="Section 5.3",
        says="The effects of those drifts are less important than those of the larger feed.",
        paper="no figures are given",
        rule="from 10 to 20 m/min the error at E grows by more than the drift of friction changes it",
        trials=trials,
    )  # fmt: skip


def linear_response(scenario: str, answer: Prediction, offset_um: dict[str, Float]) -> dict[str, Float]:
    """Return how far each axis moves (n,), um, when ``offset_um`` is added to the reference."""
    config = machine(scenario)
    moved = closed_loop.simulate_axes(
        nominal_models(config), config.axis, answer.reference.dt_s, answer.reference.position_mm,
        {axis: 1e-3 * values for axis, values in offset_um.items()},
    )  # fmt: skip
    return {axis: 1e3 * (response.table_mm - answer.predicted_mm[axis]) for axis, response in moved.items()}
