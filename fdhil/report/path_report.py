"""Reports a program's path error: before and after the correction, as a map and with its worst positions magnified."""

from collections.abc import Sequence

import numpy as np

from fdhil.prediction import CorrectionGain, find_nearest_points_mm
from fdhil.records import Correction, Float, Prediction, Trajectory, Zone
from fdhil.report import figures
from fdhil.report.figures import Curve, MapPosition
from fdhil.report.report_page import Page, Section, Table

MOST_PLACES, FEW_PLACES = 8, 4
APART_MM = 3.0  # nearer positions share one picture
FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
SEEN = 0.25  # of the picture's half width: largest error
NEAR_MIDDLE = 0.4  # of half the picture: largest distance of the largest error from the middle
LEAST_HALF_MM, MOST_HALF_MM = 0.5, 30.0
BEFORE_S, ASIDE_S = 0.05, 0.25  # shown before a zone; wider would show other passes over the same position
BESIDE = 1.5  # of a position's largest error: larger ones belong to another position
MOST_ROWS = 50


def build_prediction_page(name: str, machine: str, predicted: Prediction, parameters: str = "") -> Page:
    """Build the page of a prediction: the error's map, its zones, its worst positions. ``parameters`` names their
    source.
    """
    duration_s = predicted.reference.time_s[-1] - predicted.reference.time_s[0]
    return Page(
        title=f"Path error of {name}",
        subtitle=f"Predicted for {machine} before the cut{_describe_parameters(parameters)}.",
        headline=[*_list_headline_figures("predicted", predicted), ("duration", f"{duration_s:.2f} s")],
        sections=[
            _build_error_section([("predicted", predicted)]),
            _build_worst_section([("predicted", predicted)]),
            _build_zone_section(predicted, None),
        ],
    )


def build_correction_page(
    name: str, machine: str, planned: Correction, parameters: str = "", predicted: CorrectionGain | None = None
) -> Page:
    """Build the page of a correction, before and after; a refused one with its reasons. ``parameters`` names their
    source.

    ``predicted`` is the gain with its uncertainty; without it no factor is reported.
    """
    before, after = planned.before, planned.after
    if planned.refused:
        cases = [("uncorrected", before)]
        reasons = " ".join(f"{reason}; {reason.advice}." for reason in planned.refused)
        verdict = [("correction", "refused")]
    else:
        cases = [("uncorrected", before), (f"{planned.method} correction", after)]
        reasons = ""
        verdict = _describe_predicted_gain(after, predicted)
    return Page(
        title=f"Correction of {name}",
        subtitle=f"Planned for {machine} with the method {planned.method}{_describe_parameters(parameters)}; nothing "
        f"was sent.",
        headline=[*_list_headline_figures("uncorrected, predicted", before), *verdict],
        sections=[
            *([Section("Why it was refused", reasons)] if reasons else []),
            _build_error_section(cases),
            _build_worst_section(cases),
            _build_zone_section(before, None if planned.refused else after),
        ],
    )


def _describe_predicted_gain(after: Prediction, predicted: CorrectionGain | None) -> list[tuple[str, str]]:
    left, largest = _list_headline_figures("corrected, predicted", after)
    if predicted is None or predicted.half_um is None:
        return [left, largest, ("how well the model fits this machine", "not known here")]
    sure = predicted.at_least
    return [
        (f"{left[0]}, at most (95 %)", f"{after.rms_um + predicted.half_um:.2f} um"),
        (f"{left[0]}, by the model", f"{after.rms_um:.2f} um"),
        largest,
        ("predicted smaller by at least", "not significant" if sure is None else f"{sure:.1f} x"),
    ]


def _describe_parameters(parameters: str) -> str:
    return f", with {parameters}" if parameters else ""


def _format_um(value: float) -> str:
    if value < 0.001:
        return "below 0.001 um"
    return f"{value:.3g} um" if value < 999.5 else f"{value:.0f} um"


def _list_headline_figures(label: str, predicted: Prediction) -> list[tuple[str, str]]:
    return [
        (f"{label}, RMS", _format_um(predicted.rms_um)),
        (f"{label}, largest", _format_um(float(predicted.contour_um.max()))),
    ]


def list_planes(reference: Trajectory, rows: slice = slice(None)) -> list[tuple[str, str]]:
    """Return the planes in which the path moves, the one with most travel first; empty when one axis moves alone."""
    reach = {axis: float(np.ptp(reference.position_mm[axis][rows])) for axis in reference.table_axes}
    moving = sorted((axis for axis in reach if reach[axis] > 1e-6), key=lambda axis: -reach[axis])
    if len(moving) < 2:
        return []
    order = list(reference.table_axes)
    pairs = [(moving[0], other) for other in moving[1:]]
    return [(a, b) if order.index(a) < order.index(b) else (b, a) for a, b in pairs]


def _label_axes(reference: Trajectory, plane: tuple[str, str]) -> tuple[str, str]:
    across, along = (f"{axis} along its circumference" if axis in reference.mm_per_degree else axis for axis in plane)
    return across, along


def _project_path(reference: Trajectory, positions: Prediction | None, plane: tuple[str, str]) -> Float:
    path = reference.path_mm if positions is None else reference.compute_table_mm(positions.predicted_mm)
    return path[:, [reference.table_axes.index(axis) for axis in plane]]


def _build_error_section(cases: Sequence[tuple[str, Prediction]]) -> Section:
    reference = cases[0][1].reference
    pictures = []
    largest, least = figures.find_common_scale([predicted.contour_um for _, predicted in cases])
    same = "" if len(cases) == 1 else "; all these maps share one colour scale"
    for plane in list_planes(reference):
        path = _project_path(reference, None, plane)
        named = [MapPosition(str(k), *path[row]) for k, (_, row) in enumerate(find_worst_positions(cases[0][1]), 1)]
        for label, predicted in cases:
            caption = (
                f"{label}, plane {plane[0]}{plane[1]}: {_format_um(float(predicted.contour_um.max()))} at most{same}"
            )
            picture = figures.draw_error_map(
                path, predicted.contour_um, largest, _label_axes(reference, plane), named, least
            )
            pictures.append((caption, picture))
    errors = {label: predicted.contour_um for label, predicted in cases}
    pictures.append(("Contour error over time", figures.draw_contour_errors(reference.dt_s, errors)))
    return Section(
        "Where the error is",
        "The contour error is the distance of the table from the path, regardless of timing. The numbers mark the "
        "positions that are enlarged below.",
        figures=pictures,
    )


def find_worst_positions(predicted: Prediction) -> list[tuple[Zone, int]]:
    """Return the largest zone of each cause and size, then others up to ``FEW_PLACES``, and the sample of each.

    They are apart from each other and in the path's order; of equal ones the first is used.
    """
    reference = predicted.reference
    path = reference.path_mm
    of_kinds: dict[tuple[str, str], Zone] = {}
    for zone in sorted(predicted.zones, key=lambda zone: (-float(f"{zone.max_um:.2g}"), zone.start_s)):
        of_kinds.setdefault((zone.cause, f"{zone.max_um:.2g}"), zone)
    causes = {zone.cause: zone for zone in reversed(of_kinds.values())}
    others = sorted(predicted.zones, key=lambda zone: -zone.max_um)
    found: list[tuple[Zone, int]] = []
    for most, zones in ((MOST_PLACES, [*causes.values(), *of_kinds.values()]), (FEW_PLACES, others)):
        for zone in zones:
            row = predicted.find_worst_row(zone)
            apart = all(np.linalg.norm(path[row] - path[other]) > APART_MM for _, other in found)
            if apart and len(found) < most:
                found.append((zone, row))
    return sorted(found, key=lambda place: place[1])


def _build_worst_section(cases: Sequence[tuple[str, Prediction]]) -> Section:
    before = cases[0][1]
    pictures = []
    for number, (zone, row) in enumerate(find_worst_positions(before), 1):
        caption, picture = _draw_worst_position(cases, zone, row)
        pictures.append((f"{number}: {caption}", picture))
    text = "The largest zones in the order of the path, numbered as in the map."
    return Section("Worst positions enlarged", text if pictures else "No zone stands out.", figures=pictures)


def _draw_worst_position(cases: Sequence[tuple[str, Prediction]], zone: Zone, row: int) -> tuple[str, str]:
    reference = cases[0][1].reference
    inside = cases[0][1].get_zone_rows(zone)
    first, last = inside.start, inside.stop
    before, aside = round(BEFORE_S / reference.dt_s), round(ASIDE_S / reference.dt_s)
    rows = slice(max(0, first - aside), last + aside)
    line = f"line {reference.line[row]}, " if reference.line[row] else ""
    caption = f"{line}{zone.where}: {zone.cause}, {zone.max_um:.1f} um"
    found = list_planes(reference, rows)
    if not found:
        axis = max(reference.axes, key=lambda a: float(np.ptp(reference.position_mm[a][rows])))
        errors = {label: predicted.error_um[axis][rows] for label, predicted in cases}
        return caption, figures.draw_axis_errors(reference.time_s[rows], errors, axis)
    plane = found[0]
    columns = [reference.table_axes.index(axis) for axis in plane]
    path = _project_path(reference, None, plane)
    seen = path[max(0, first - before) : last]
    wide, tall = np.ptp(seen, axis=0)
    half = float(np.clip(0.6 * max(wide, tall / figures.TALL), LEAST_HALF_MM, MOST_HALF_MM))
    factor = max(f for f in FACTORS if f == 1 or f * zone.max_um * 1e-3 <= SEEN * half)
    curves = [Curve("desired", path[rows])]
    for label, predicted in cases:
        at = find_nearest_mm(predicted, rows)[:, columns]
        drawn = figures.magnify_deviation(at, _project_path(reference, predicted, plane)[rows], factor)
        # magnified, a worse position nearby would cover this one
        drawn[predicted.contour_um[rows] > BESIDE * zone.max_um] = np.nan
        curves.append(Curve(label, drawn))
    # the picture includes the zone's errors
    worst = curves[1].path_mm[first - rows.start : last - rows.start]
    low, high = (np.vstack([seen, worst]).min(axis=0), np.vstack([seen, worst]).max(axis=0))
    half = min(MOST_HALF_MM, max(half, 0.55 * float(max(high[0] - low[0], (high[1] - low[1]) / figures.TALL))))
    # a zone too large for the picture is cut where its error is smaller
    worst_mm = (path[row] + curves[1].path_mm[row - rows.start]) / 2
    reach = NEAR_MIDDLE * half * np.array([1.0, figures.TALL])
    across, along = np.clip((low + high) / 2, worst_mm - reach, worst_mm + reach)
    larger = f", errors {factor} times as large" if factor > 1 else ""
    return caption + larger, figures.draw_path_detail(
        curves, (float(across), float(along)), half, _label_axes(reference, plane), on_path=False
    )


def find_nearest_mm(predicted: Prediction, rows: slice) -> Float:
    """Return for each predicted point of ``rows`` the nearest point (m, d) of the path, from which its contour error
    counts.
    """
    reference = predicted.reference
    actual = reference.compute_table_mm(predicted.predicted_mm)[rows]
    return find_nearest_points_mm(reference.path_mm, actual, reference.dt_s, rows.start)


def _build_zone_section(before: Prediction, after: Prediction | None) -> Section:
    reference = before.reference
    largest = sorted(before.zones, key=lambda zone: -zone.max_um)[:MOST_ROWS]
    numbers = {row: str(k) for k, (_, row) in enumerate(find_worst_positions(before), 1)}
    rows = []
    for zone in sorted(largest, key=lambda zone: zone.start_s):
        row = before.find_worst_row(zone)
        times = f"{zone.start_s:.2f} to {zone.end_s:.2f}"
        cells = [numbers.get(row, ""), times, str(reference.line[row] or ""), zone.where, zone.cause]
        cells.append(f"{zone.max_um:.1f}")
        rows.append(cells if after is None else [*cells, f"{after.contour_um[before.get_zone_rows(zone)].max():.2f}"])
    if not rows:
        return Section("Zones", "No zone stands out.")
    left_out = len(before.zones) - len(rows)
    text = f"The {MOST_ROWS} largest; {left_out} smaller ones are left out (--json lists them)." if left_out else ""
    head = ["position", "time (s)", "line", "where", "cause", "at most (um)"]
    return Section("Zones", text, [Table(head if after is None else [*head, "corrected, at most (um)"], rows)])
