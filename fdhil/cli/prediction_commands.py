"""``fdhil predict`` and ``fdhil correct``: the path error of a program before the cut, and its correction."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import tables
from fdhil.api import announce_compilation
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import (
    AS_JSON,
    CONFIG_OPTION,
    FROM_HISTORY,
    MODEL,
    PROGRAM,
    OutputFile,
    PositiveFloat,
    WritingCommand,
)
from fdhil.records import INTERVAL_95
from fdhil.report import INTERVAL_MEANING

if TYPE_CHECKING:
    from fdhil.cli.history_forecast import ProgramHistory
    from fdhil.config import MachineConfig
    from fdhil.prediction import CorrectionGain, ParameterStep
    from fdhil.records import Correction, Float, Parameters, Prediction, Trajectory

MANY_ZONES = 12


@dataclass(frozen=True, slots=True)
class PredictionOptions:
    """Argument and options that both commands share."""

    program: Path
    config_path: Path
    model_path: Path | None
    from_history: bool
    out: Path | None
    report: Path | None
    pdf: Path | None
    as_json: bool


def _add_shared_options(wanted: Callable[..., int | None]) -> Callable[..., int | None]:
    @functools.wraps(wanted)
    def run_with_options(**options: Any) -> int | None:
        if options["report"] or options["pdf"]:
            from fdhil.report import require_libraries

            require_libraries()  # before the computation
        own = {name: value for name, value in options.items() if name not in PredictionOptions.__dataclass_fields__}
        return wanted(
            PredictionOptions(**{name: options[name] for name in PredictionOptions.__dataclass_fields__}), **own
        )

    for option in (
        AS_JSON,
        click.option("--pdf", type=OutputFile(".pdf"), help="Write that page as PDF (needs chromium)."),
        click.option("--report", type=OutputFile(), help="Write an HTML page with error map and worst locations."),
        click.option("--out", type=OutputFile(), help="Write a CSV with one row per SYNC period."),
        FROM_HISTORY,
        MODEL,
        CONFIG_OPTION,
        PROGRAM,
    ):  # the last one is shown first
        option(run_with_options)
    return run_with_options


@click.command(cls=WritingCommand)
@_add_shared_options
@click.option("--sensitivity", is_flag=True, help="Show per zone the error change, um, for 1 % of each parameter.")
@click.option(
    "--tolerance-um",
    type=PositiveFloat(),
    help="Forecast when each zone exceeds this tolerance, um, from the parameter trends (needs --from-history).",
)
@click.option(
    "--since",
    type=int,
    metavar="REVISION",
    help="Compare inertia and friction with this revision (needs --from-history; default: the last step).",
)
def predict(options: PredictionOptions, sensitivity: bool, tolerance_um: float | None, since: int | None) -> None:
    """Predict the path error of a PROGRAM (NC program or demand CSV) before it is cut.

    Uses the nominal parameters of the configuration unless --model or --from-history is given. Programs are interpreted
    as in LinuxCNC 2.9, modified by [nc] dwell_unit and integers.

    With --from-history the contour error gets a standard deviation from the covariance of the parameters, and steps of
    inertia or friction are shown with their cost. The prediction is stored; the next one of the same program shows the
    change of each zone and the parameters that caused it.
    """
    if not options.from_history and (tolerance_um is not None or since is not None):
        raise click.UsageError("--tolerance-um and --since need --from-history")
    reference, models, config = load_inputs(
        options.program, options.config_path, options.model_path, options.from_history
    )
    from fdhil import prediction
    from fdhil.correction import build_prediction_document

    announce_compilation("predict")
    predicted = prediction.predict_path(reference, models, config)
    columns = _build_prediction_columns(predicted)
    document = {
        "schema": "fdhil-predict-1",
        "program": str(options.program),
        **build_prediction_document(predicted, models),
    }
    um_per_percent = None
    if sensitivity or tolerance_um is not None:
        um_per_percent = prediction.compute_sensitivity_um(predicted, models, config)
        for zone, per_axis in zip(document["zones"], um_per_percent, strict=True):
            zone["um_per_percent"] = per_axis
    steps: Sequence[ParameterStep] = ()
    if options.from_history:
        std_um, steps = _add_history(
            document, options.program, predicted, models, config, since, um_per_percent, tolerance_um
        )
        columns["contour_std_um"] = (std_um, 4)
    if options.out is not None:
        _write_columns(options.out, columns)
    _write_report(options, config, predicted)
    if options.as_json:
        click.echo(json.dumps(document, allow_nan=False))
        return
    from fdhil.cli import history_forecast

    _show_prediction(predicted, document["zones"], tolerance_um)
    history_forecast.show_steps(steps)
    history_forecast.show_zone_changes(document.get("compared"))


def _add_history(
    document: dict[str, Any],
    program: Path,
    predicted: Prediction,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    since: int | None,
    um_per_percent: Sequence[Mapping[str, Mapping[str, float]]] | None,
    tolerance_um: float | None,
) -> tuple[Float, Sequence[ParameterStep]]:
    """Add the history's results to the document and store this prediction.

    Returns the standard deviation of the contour error, (n,) um, and the parameter steps.
    """
    from fdhil import prediction
    from fdhil.cli import history_forecast
    from fdhil.program import compute_program_digest

    digest = compute_program_digest(program)
    past = history_forecast.ProgramHistory.read(config, digest)
    reference, zones = predicted.reference, document["zones"]
    std_um = prediction.compute_contour_std_um(reference, models, _collect_covariances(reference, past), config)
    document["contour"]["max_std_um"] = float(std_um.max())
    for entry, zone in zip(zones, predicted.zones, strict=True):
        entry["std_um"] = float(std_um[predicted.find_worst_row(zone)])
    steps = history_forecast.estimate_step_costs(past, predicted, models, config, since)
    document["steps"] = history_forecast.describe_steps(steps)
    now = history_forecast.build_comparison(program, digest, past, predicted, models, config, zones)
    document["compared"] = history_forecast.compare_zones(past, now, predicted, std_um, config)
    history_forecast.store_comparison(past, now, config)
    if tolerance_um is not None and um_per_percent is not None:
        document["tolerance_um"] = tolerance_um
        for zone, when in zip(
            zones,
            history_forecast.predict_crossings(past, predicted, um_per_percent, models, tolerance_um),
            strict=True,
        ):
            zone["crosses"] = when
    return std_um, steps


@click.command(cls=WritingCommand)
@_add_shared_options
@click.option("--method", type=click.Choice(list(tables.CORRECTIONS)), help="Correction method (default: the best).")
@require_delivered_answer
def correct(options: PredictionOptions, method: str | None) -> int:
    """Plan the offsets that correct the path error of a PROGRAM (NC program or demand CSV).

    Nothing is sent. A correction without a predicted improvement is refused with advice, and its offsets are 0.
    """
    reference, models, config = load_inputs(
        options.program, options.config_path, options.model_path, options.from_history
    )
    from fdhil import correction
    from fdhil.api import find_held_out_max_um
    from fdhil.correction import build_correction_document
    from fdhil.prediction import load_model_file
    from fdhil.store import predict_gain_from_history

    announce_compilation("predict", "correct")
    held_out_um = {} if options.model_path is None else load_model_file(options.model_path).held_out_um
    largest_um = find_held_out_max_um(reference, config, "history" if options.from_history else options.model_path)
    planned = correction.plan_correction(reference, models, config, method, largest_um)
    predicted = predict_gain_from_history(planned, models, config, options.from_history, held_out_um)
    if options.out is not None:
        _write_columns(options.out, _build_correction_columns(planned))
    _write_report(options, config, planned, predicted)
    if options.as_json:
        click.echo(
            json.dumps(build_correction_document(str(options.program), planned, predicted, models), allow_nan=False)
        )
    else:
        _show_correction(planned, predicted, models)
    return 1 if planned.refused else 0


def _write_report(
    options: PredictionOptions,
    config: MachineConfig,
    found: Prediction | Correction,
    predicted: CorrectionGain | None = None,
) -> None:
    if options.report is None and options.pdf is None:
        return
    from fdhil.records import Prediction
    from fdhil.report import build_correction_page, build_prediction_page, write_page_or_pdf

    name, machine = options.program.name, config.machine.name
    parameters = "the nominal parameters of the configuration"
    if options.from_history:
        parameters = "the newest parameters of the history"
    elif options.model_path is not None:
        parameters = f"the parameters of {options.model_path.name}"
    if isinstance(found, Prediction):
        page = build_prediction_page(name, machine, found, parameters)
    else:
        page = build_correction_page(name, machine, found, parameters, predicted)
    write_page_or_pdf(page, options.report, options.pdf)


def load_inputs(
    program: Path, config_path: Path, model_path: Path | None, from_history: bool
) -> tuple[Trajectory, dict[str, Parameters], MachineConfig]:
    """Read configuration, model and reference, in this order; loops of the model replace those of the configuration."""
    if model_path is not None and from_history:
        raise click.UsageError("--model and --from-history exclude each other; give only one of them")
    from fdhil.api import Machine, read_inputs

    print_note = functools.partial(click.echo, err=True)

    return read_inputs(program, Machine.load(config_path), "history" if from_history else model_path, print_note)


def _collect_covariances(reference: Trajectory, past: ProgramHistory) -> dict[str, Float]:
    import numpy as np

    known = {axis: found[-1].set.covariance for axis, found in past.revisions.items() if found}
    return {axis: known.get(axis, np.zeros((6, 6))) for axis in reference.axes}


def _build_prediction_columns(predicted: Prediction) -> dict[str, tuple[Float, int]]:
    """Return the CSV columns: header -> values (n,) and number of decimals."""
    reference = predicted.reference
    columns: dict[str, tuple[Float, int]] = {"time_s": (reference.time_s, 6 if reference.dt_s >= 1e-5 else 9)}
    for axis in reference.axes:
        unit = "deg" if axis in reference.mm_per_degree else "mm"
        factor = reference.mm_per_degree.get(axis, 1.0)
        columns[f"{axis}_reference_{unit}"] = (reference.position_mm[axis] / factor, 6)
        columns[f"{axis}_predicted_{unit}"] = (predicted.predicted_mm[axis] / factor, 6)
        columns[f"{axis}_error_um"] = (predicted.error_um[axis], 4)
    columns["contour_error_um"] = (predicted.contour_um, 4)
    return columns


def _build_correction_columns(planned: Correction) -> dict[str, tuple[Float, int]]:
    columns = _build_prediction_columns(planned.before)
    for axis in planned.before.reference.axes:
        columns[f"{axis}_offset_um"] = (planned.offset_um[axis], 4)
        if axis in planned.torque_offset_nm:
            columns[f"{axis}_speed_offset_rad_per_s"] = (planned.speed_offset_rad_s[axis], 6)
            columns[f"{axis}_torque_offset_Nm"] = (planned.torque_offset_nm[axis], 6)
        columns[f"{axis}_corrected_error_um"] = (planned.after.error_um[axis], 4)
    columns["corrected_contour_error_um"] = (planned.after.contour_um, 4)
    return columns


def _write_columns(path: Path, columns: Mapping[str, tuple[Float, int]]) -> None:
    import numpy as np

    from fdhil.store import open_output

    # adding 0 after rounding turns -0.0000 into 0.0000
    values = np.column_stack([np.round(values, decimals) + 0.0 for values, decimals in columns.values()])
    formats = [f"%.{decimals}f" for _, decimals in columns.values()]
    with open_output(path) as file:
        np.savetxt(file, values, fmt=formats, delimiter=",", header=",".join(columns), comments="")


def _show_prediction(
    predicted: Prediction, zones: Sequence[Mapping[str, Any]] | None = None, tolerance_um: float | None = None
) -> None:
    from fdhil.cli.history_forecast import format_crossing
    from fdhil.correction import build_contour_document, build_zone_documents
    from fdhil.prediction import format_half_interval

    contour, time_s = build_contour_document(predicted), predicted.reference.time_s
    click.echo(
        f"{time_s[-1] - time_s[0]:.2f} s of path: contour error {contour['rms_um']:.1f} um RMS,"
        f" {contour['max_um']:.1f} um at most" + (f"; {INTERVAL_MEANING}" if zones and "std_um" in zones[0] else "")
    )
    entries = build_zone_documents(predicted) if zones is None else zones
    shown = sorted(sorted(entries, key=lambda zone: -zone["max_um"])[:MANY_ZONES], key=lambda zone: zone["start_s"])
    for note in predicted.reference.notes:
        click.echo(f"note, {note}; {note.advice}", err=True)
    for zone in shown:
        std = f" {format_half_interval(INTERVAL_95 * zone['std_um'])}" if "std_um" in zone else ""
        line = f"line {zone['line']}, " if zone["line"] else ""
        click.echo(
            f"  {zone['start_s']:8.3f} s .. {zone['end_s']:8.3f} s  {zone['max_um']:8.1f}{std} um  {zone['cause']:12}"
            f"  at {line}{zone['where']}"
        )
        if "um_per_percent" in zone:
            click.echo(f"{'':26}{_describe_sensitivity(zone['um_per_percent'])}")
        if "crosses" in zone and tolerance_um is not None:
            click.echo(f"{'':26}{format_crossing(zone['crosses'], tolerance_um)}")
    if len(entries) > len(shown):
        click.echo(f"  and {len(entries) - len(shown)} smaller zones (--json lists all)")


def _describe_sensitivity(per_axis: Mapping[str, Mapping[str, float]]) -> str:
    rise, axis, name = max(
        ((rise, axis, name) for axis, values in per_axis.items() for name, rise in values.items()),
        key=lambda item: abs(item[0]),
    )
    return f"1 % more {name} of axis {axis} changes the error by {rise:+.2f} um"


def _show_correction(planned: Correction, predicted: CorrectionGain, models: Mapping[str, Parameters]) -> None:
    from fdhil.correction import build_contour_document, list_prediction_points

    _show_prediction(planned.before)
    for reason in planned.warnings:
        click.echo(f"warning, {reason}; {reason.advice}", err=True)
    for reason in planned.refused:
        click.echo(f"refused, {reason}; {reason.advice}")
    if not planned.refused:
        sure = "" if predicted.at_least is None else f", at least {predicted.at_least:.1f} times better"
        most = f"{build_contour_document(planned.after)['max_um']:.1f} um at most"
        click.echo(f"predicted with the {planned.method} correction: {predicted}; {most}{sure}")
        blind = [axis for axis, where in list_prediction_points(models).items() if where == "encoder"]
        if blind:
            text = f"this applies at the encoders of {', '.join(blind)}, which do not measure oscillation of the table"
            click.echo(f"{text}; if the table oscillates behind its motor, set resonance_hz of the axis")
