"""Report of the demonstration: the figures of the paper for the identified machine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction import plan_correction as plan_correction
from fdhil.prediction import predict_path
from fdhil.records import (
    INTERVAL_95,
    PARAMETERS,
    UNITS,
    Correction,
    Float,
    Parameters,
    Prediction,
    Trajectory,
    Window,
    get_unit,
)
from fdhil.report import (
    DISPLAY_UNITS,
    Curve,
    MapPosition,
    Page,
    Section,
    Table,
    draw_contour_errors,
    draw_drift,
    draw_error_map,
    draw_model_comparison,
    draw_path,
    draw_path_detail,
    draw_signals,
    draw_torque,
    find_common_scale,
    format_cell,
    magnify_deviation,
)

# named locations of the path, mm
POINTS: Mapping[str, tuple[float, float]] = {
    "A": (0.0, 55.0), "B": (50.0, 55.0), "C": (100.0, 55.0), "D": (150.0, 5.0), "E": (200.0, 55.0), "F": (225.0, 55.0),
    "G": (250.0, 55.0),
}  # fmt: skip
ENLARGED = 100  # for residual errors of some micrometres
MAGNIFIED = 10  # for errors of 100 um at corners that the NC rounds by millimetres
# [DES] 5.3: the drifts whose effect at E is shown, on X only
DRIFTS: Sequence[tuple[str, Mapping[str, float]]] = (
    ("ft 0.01, Cd 1 on X", {"ft": 0.01, "Cd": 1.0}),
    ("Jt + 13 % on X", {"Jt": 1.13}),
)


def compute_rms(values: Float) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True, slots=True)
class CutPass:
    """One pass over the path, measured at the simulated table."""

    label: str
    temperature_c: float
    reference_mm: Float
    table_mm: Float
    contour_um: Float
    late_offsets: int

    @property
    def rms_um(self) -> float:
        """RMS contour error, um."""
        return compute_rms(self.contour_um)

    @property
    def max_um(self) -> float:
        """Largest contour error, um."""
        return float(self.contour_um.max())


@dataclass(frozen=True, slots=True)
class Published:
    """One published parameter set: values, standard deviations and slide-way temperature."""

    parameters: Parameters
    std: Mapping[str, float]
    temperature_c: float


@dataclass(frozen=True, slots=True)
class DemoResult:
    """Results of the demonstration."""

    config: MachineConfig
    truth: Mapping[str, Parameters]
    published: Mapping[str, Sequence[Published]]
    cold: Mapping[str, tuple[Window, float | None]]
    warm: Mapping[str, Window]
    predicted: Prediction
    programs: Mapping[str, Trajectory]
    cuts: Sequence[CutPass]
    frames: tuple[int, int]


def build_demo_page(loop: DemoResult, headline: Sequence[tuple[str, str]] = (), more: Sequence[Section] = ()) -> Page:
    """Return the report, with additional headlines and sections."""
    before, mirror, after = loop.cuts[:3]
    return Page(
        title="From rapid moves to a corrected path",
        subtitle="A simulated two-axis machine, identified in motion, predicted, and corrected over its own bus.",
        headline=[
            ("contour error measured before, RMS", f"{before.rms_um:.1f} um"),
            ("predicted before the cut", f"{compute_rms(loop.predicted.contour_um):.1f} um"),
            ("measured with the paper's mirror", f"{mirror.rms_um:.2f} um"),
            ("measured with the inverse, RMS", f"{after.rms_um:.2f} um"),
            ("measured reduction", f"{before.rms_um / after.rms_um:.0f} x"),
            *headline,
        ],
        sections=[
            _build_identification_section(loop),
            _build_drift_section(loop),
            _build_path_section(loop),
            _build_prediction_section(loop),
            _build_correction_section(loop),
            *more,
        ],
    )


def list_parameter_rows(loop: DemoResult) -> list[list[str]]:
    """Return the parameter table: axis, symbol, true value, identified value with interval, deviation."""
    return [
        row for axis, truth in loop.truth.items() for row in list_identified_rows(axis, truth, loop.published[axis][0])
    ]


def list_identified_rows(axis: str, truth: Parameters, found: Published) -> list[list[str]]:
    """Return the rows of one axis; additional terms have no true value."""
    rows = []
    for name in PARAMETERS:
        true, value, std = getattr(truth, name), getattr(found.parameters, name), found.std[name]
        unit, factor = DISPLAY_UNITS[name]
        found_text, deviation = format_cell(name, value, INTERVAL_95 * std, " "), f"{100 * (value / true - 1):+.2f} %"
        rows.append([axis, name, f"{true * factor:.5g} {unit}", found_text, deviation])
    for name, value in found.parameters.terms:
        shown = format_cell(name, value, INTERVAL_95 * found.std[name], " ")
        rows.append([axis, name, "", f"{shown} {get_unit(name)}".rstrip(), ""])
    return rows


def list_cut_rows(loop: DemoResult) -> list[list[str]]:
    """Return the table of contour errors: predicted, then measured per pass."""
    rows = [
        ["predicted", "", f"{compute_rms(loop.predicted.contour_um):.2f}", f"{loop.predicted.contour_um.max():.1f}", ""]
    ]
    return rows + format_cut_rows(loop.cuts)


def format_cut_rows(cuts: Sequence[CutPass]) -> list[list[str]]:
    """Return one row per measured pass."""
    return [
        [cut.label, f"{cut.temperature_c:.1f}", f"{cut.rms_um:.2f}", f"{cut.max_um:.1f}", str(cut.late_offsets)]
        for cut in cuts
    ]


CUT_HEAD = ("pass", "slide-way degC", "RMS um", "max um", "late offsets")
PARAMETER_HEAD = ("axis", "symbol", "true", "identified (± 95 %)", "deviation")


def _build_identification_section(loop: DemoResult) -> Section:
    pictures = []
    for axis, (window, fit_percent) in loop.cold.items():
        found = loop.published[axis][0].parameters
        caption = f"Axis {axis}: voltage, current and speed of one rapid move, as measured (Figure 4 of the paper)"
        pictures.append((caption, draw_signals(window)))
        caption = f"Axis {axis}: speed of model and drive for the measured voltage, and their difference (Figure 8)"
        pictures.append((caption, draw_model_comparison(window, found, fit_percent)))
    received, lost = loop.frames
    return Section(
        "Identified during rapid moves",
        f"Voltage, current and speed were recorded over CANopen while the axes shuttled; {received:,} frames were "
        f"received and {lost} lost. Each parameter is shown with half of its 95 % interval and its true value.",
        tables=[Table(PARAMETER_HEAD, list_parameter_rows(loop))],
        figures=pictures,
    )


def _build_drift_section(loop: DemoResult) -> Section:
    pictures = []
    for axis, warm in loop.warm.items():
        cold, first, last = loop.cold[axis][0], loop.published[axis][0], loop.published[axis][-1]
        cases = [(f"{found.temperature_c:.1f} degC", window, found.parameters)
                 for window, found in ((cold, first), (warm, last))]  # fmt: skip
        caption = f"Axis {axis}: torque of a rapid move with cold and with warm slide-ways, from the model (Figure 5)"
        pictures.append((caption, draw_torque(cases)))
    for symbol, meaning, number in (("ft", "Viscous friction", 6), ("Cd", "Coulomb friction", 7)):
        series = {axis: _collect_series(sets, symbol) for axis, sets in loop.published.items()}
        what = f"{meaning} {symbol} over the temperature of the slide-ways"
        caption = f"{what}, with its 95 % intervals (Figure {number})"
        pictures.append((caption, draw_drift(symbol, UNITS[symbol], series)))
    return Section(
        "Drift with the slide-ways' temperature",
        "The slide-ways were warmed while the axes kept shuttling. Only rapids were used.",
        figures=pictures,
    )


def _collect_series(sets: Sequence[Published], symbol: str) -> tuple[Float, Float, Float]:
    return (
        np.array([found.temperature_c for found in sets]),
        np.array([getattr(found.parameters, symbol) for found in sets]),
        np.array([found.std[symbol] for found in sets]),
    )


def _collect_models(loop: DemoResult) -> dict[str, Parameters]:
    return {axis: sets[0].parameters for axis, sets in loop.published.items()}


def _join_xy(positions: Mapping[str, Float]) -> Float:
    return np.column_stack([positions["X"], positions["Y"]])


def _build_path_section(loop: DemoResult) -> Section:
    slow = _join_xy(loop.programs["10 m/min"].position_mm)
    rounded = _join_xy(loop.programs["rounded"].position_mm)
    return Section(
        "The programmed path",
        figures=[
            ("The path and its named places (Figure 10)", draw_path(slow, POINTS)),
            ("The rounded variant for a 40 mm cutter (Figure 19)", draw_path(rounded, {})),
        ],
    )


def _build_prediction_section(loop: DemoResult) -> Section:
    models = _collect_models(loop)
    feeds = {feed: predict_path(loop.programs[feed], models, loop.config) for feed in ("10 m/min", "20 m/min")}
    slow = loop.programs["10 m/min"]
    pictures = []
    for place, number in (("A", 11), ("C", 12), ("E", 13)):
        curves = [Curve("desired, 10 m/min", _join_xy(slow.position_mm))]
        for feed, answer in feeds.items():
            desired = _join_xy(answer.reference.position_mm)
            curves.append(Curve(feed, magnify_deviation(desired, _join_xy(answer.predicted_mm), MAGNIFIED)))
        curves.append(Curve("desired, 20 m/min", _join_xy(loop.programs["20 m/min"].position_mm), dashed=True))
        caption = f"Predicted path at {place} for two feeds, errors {MAGNIFIED} times as large (Figure {number})"
        pictures.append((caption, draw_path_detail(curves, POINTS[place], 8.0)))
    for (label, change), number in zip(DRIFTS, (14, 15), strict=True):
        drifted = predict_path(slow, models | {"X": _apply_drift(models["X"], change)}, loop.config)
        curves = [
            Curve("desired", _join_xy(slow.position_mm)),
            Curve("as identified", _join_xy(feeds["10 m/min"].predicted_mm)),
            Curve(label, _join_xy(drifted.predicted_mm), dashed=True),
        ]
        pictures.append((f"Effect at E of {label} (Figure {number})", draw_path_detail(curves, POINTS["E"], 0.2)))
    worst = [[f"{z.start_s:.2f} to {z.end_s:.2f}", z.where, f"{z.max_um:.1f}", z.cause] for z in loop.predicted.zones]
    return Section(
        "Predicted before the cut",
        "The closed loops of both drives were simulated with the identified parameters; nothing here is measured.",
        tables=[Table(("time (s)", "where", "at most (um)", "cause"), worst, "Zones of the path, 10 m/min")],
        figures=pictures,
    )


def _apply_drift(parameters: Parameters, change: Mapping[str, float]) -> Parameters:
    # friction as an absolute value, inertia as a factor
    values = {name: value * parameters.Jt if name == "Jt" else value for name, value in change.items()}
    return parameters.replace_values(**values)


def _build_correction_section(loop: DemoResult) -> Section:
    before = loop.cuts[0]
    measured = [
        Curve("desired", before.reference_mm),
        *(Curve(cut.label, magnify_deviation(cut.reference_mm, cut.table_mm, ENLARGED)) for cut in loop.cuts[:3]),
    ]
    errors = {cut.label: cut.contour_um for cut in loop.cuts}
    rounded, inverse = (
        plan_correction(loop.programs["rounded"], _collect_models(loop), loop.config, method)
        for method in ("mirror", "inverse")
    )
    larger = f"errors {ENLARGED} times as large"
    return Section(
        "Cut without and with the correction",
        "Measured at the simulated table; the guard checks the offsets and sends them over the bus.",
        tables=[Table(CUT_HEAD, list_cut_rows(loop), "Contour error, 10 m/min")],
        figures=[
            (
                "Contour error along the path, measured per pass (the loop of Figure 16, closed)",
                draw_contour_errors(loop.config.machine.sync_period_s, errors),
            ),
            *_draw_error_maps((before, loop.cuts[2])),
            (f"Area A, measured, {larger} (Figure 17)", draw_path_detail(measured, POINTS["A"], 6.0)),
            (
                f"The straight after A, measured, {larger} (Figure 18)",
                draw_path_detail(measured, (20.0, 55.0), 12.0),
            ),
            (f"Area E, measured, {larger}", draw_path_detail(measured, POINTS["E"], 6.0)),
            (f"Rounded path at the end of A, simulated, {larger} (Figure 20)", _draw_rounded_path(rounded, inverse)),
        ],
    )


def _draw_error_maps(cuts: Sequence[CutPass]) -> list[tuple[str, str]]:
    largest, least = find_common_scale([cut.contour_um for cut in cuts])
    places = [MapPosition(name, *at) for name, at in POINTS.items()]
    return [
        (
            f"Where the error is, {cut.label}: {cut.max_um:.1f} um at most; both maps have the same colour scale",
            draw_error_map(cut.reference_mm, cut.contour_um, largest, places=places, least_um=least),
        )
        for cut in cuts
    ]


def _draw_rounded_path(mirror: Correction, inverse: Correction) -> str:
    desired = _join_xy(mirror.before.reference.position_mm)
    cases = {"uncorrected": mirror.before, "mirror": mirror.after, "inverse": inverse.after}
    curves = [Curve("desired", desired)]
    curves += [
        Curve(label, magnify_deviation(desired, _join_xy(answer.predicted_mm), ENLARGED))
        for label, answer in cases.items()
    ]
    return draw_path_detail(curves, (20.0, 75.0), 12.0)
