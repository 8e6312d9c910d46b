"""``fdhil identify``: drive parameters with their intervals from recordings, or the reasons of a refusal."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import report as reports
from fdhil import tables
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, FILE, OutputFile, PictureFile, WritingCommand
from fdhil.records import INTERVAL_95, get_unit
from fdhil.report import INTERVAL_MEANING, format_cell, format_heading
from fdhil.store import RECORDING_SUFFIXES, open_output

if TYPE_CHECKING:
    from fdhil.api import FileResult
    from fdhil.config import Axis, Identification, MachineConfig
    from fdhil.records import Estimate, Verdict
    from fdhil.store import ColumnMap

PROPOSE = "?"  # of --columns
BESIDE = "-"  # of --plot without a name
UNREADABLE = 3


@click.command(cls=WritingCommand)
@click.argument("recordings", nargs=-1, required=True, type=FILE, metavar="RECORDING...")
@click.option("--config", "config_path", type=FILE, help="Machine configuration (TOML).")
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Estimator (default: the best).")
@click.option(
    "--write-model",
    "model",
    type=OutputFile(".json"),
    help="Write the validated parameters, terms and loops as a model file for fdhil predict and correct.",
)
@click.option("--loops", "with_loops", is_flag=True, help="Identify the control loops of the drive as well.")
@click.option(
    "--accelerometer",
    type=FILE,
    help="Accelerometer recording of the table in the same run (CSV in Klipper's format); for one RECORDING.",
)
@click.option(
    "--any-move", is_flag=True, help="Use each recording as one window of arbitrary motion, such as a laboratory test."
)
@click.option(
    "--report", type=OutputFile(".html"), help="Write an HTML page of one RECORDING: signals, model and residuals."
)
@click.option(
    "--plot",
    is_flag=False,
    flag_value=BESIDE,
    type=PictureFile(),
    help="Plot signals, model and residuals of one RECORDING (.png, .svg, .pdf; default: next to it).",
)
@click.option(
    "--columns",
    type=FILE,
    help="Column map (TOML) of a foreign file; ? writes a proposal from names, units and physics.",
)
@AS_JSON
@require_delivered_answer
def identify(
    recordings: tuple[Path, ...],
    config_path: Path | None,
    method: str | None,
    model: Path | None,
    with_loops: bool,
    accelerometer: Path | None,
    any_move: bool,
    report: Path | None,
    plot: Path | None,
    columns: Path | None,
    as_json: bool,
) -> int:
    """Identify a drive from the rapid moves in each RECORDING.

    A RECORDING is a CSV, Parquet, MATLAB, MDF 4 or HDF5 file, a file of another program with --columns, or a folder,
    which is searched with its subfolders. Voltage, current and speed are sufficient signals.

    Each rapid is one window: it is checked, the six parameters are estimated, and the model is validated. All accepted
    windows of a file give its pooled parameters. --config compares them with the nominal values of the axis; only this
    comparison can detect a constant gain error of a sensor.

    Without a voltage signal, K is taken from the header torque_constant_nm_per_a, else from --config. If the configured
    control loops do not explain the rapids, and always with --loops, the loops of the drive are identified.

    --any-move uses the whole of a laboratory recording (steps, ramps, chirps, locked rotor). Parameters that it cannot
    determine are null, with the reason.
    """
    recordings = tuple(_expand_folders(recordings))
    for option, value in (("--accelerometer", accelerometer), ("--report", report), ("--plot", plot)):
        if value is not None and len(recordings) > 1:
            raise click.UsageError(f"{option} applies to one recording; give a single RECORDING")
    if report is not None or plot is not None:
        reports.require_libraries()
    settings, machine = _load_settings(config_path, method)
    axes = machine.axis if machine is not None else {}
    column_map = _read_or_propose_columns(columns, recordings, as_json=as_json)
    if columns is not None and column_map is None:
        return 1
    results = _analyse_with_progress(recordings, settings, machine, accelerometer, column_map, any_move=any_move)
    from fdhil.api import build_identification_document, compare_with_data_sheet

    if machine is not None:
        results = [compare_with_data_sheet(result, axes) for result in results]
    if with_loops:
        from fdhil.api import identify_all_loops

        results = identify_all_loops(results, settings, machine)
    if model is not None:
        from fdhil.cli.model_file import write_model

        write_model(results, axes, model)
    _write_figures(results[0], report, plot)
    if as_json:
        click.echo(json.dumps(build_identification_document(results, axes, with_loops=with_loops), allow_nan=False))
    else:
        _show_results(results, axes, with_loops)
    if any(result.error for result in results):
        return UNREADABLE
    return 0 if all(r.verdict.accepted for r in results) else 1


def _read_or_propose_columns(columns: Path | None, recordings: Sequence[Path], *, as_json: bool) -> ColumnMap | None:
    # None: the proposal is to be checked by the user first
    from fdhil.store import read_column_map

    if columns is None:
        return None
    if str(columns) != PROPOSE:
        return read_column_map(columns)
    from fdhil.store import propose_columns

    proposal = propose_columns(recordings[0])
    path = recordings[0].with_suffix(".columns.toml")
    if path.exists():
        raise click.UsageError(f"{path} exists and is not overwritten; give it with --columns, or remove it")
    with open_output(path) as file:
        file.write(proposal.toml.encode())
    for line in proposal.format_lines():
        click.echo(line, err=True)
    click.echo(f"proposed column map: {path}", err=True)
    faults = proposal.faults
    if faults or as_json or not sys.stdin.isatty():
        what = f"Missing: {'; '.join(faults)}. " if faults else ""
        click.echo(f"{what}Check it, then: fdhil identify {recordings[0]} --columns {path}", err=True)
        return None
    return read_column_map(path) if click.confirm("Identify with it?", err=True) else None


def _write_figures(result: FileResult, report: Path | None, plot: Path | None) -> None:
    if result.error is not None or (report is None and plot is None):
        return
    from fdhil.report import build_identification_page, save_picture

    if report is not None:
        reports.write_page(build_identification_page(result), report)
    if plot is not None:
        save_picture(result, Path(result.file).with_suffix(".png") if str(plot) == BESIDE else plot)


def _expand_folders(recordings: Sequence[Path]) -> Iterator[Path]:
    """Yield the files; of a folder, all with the suffix of a recording.

    A folder without recordings, or an unreadable one, is yielded itself: reading it reports the reason.
    """
    for path in recordings:
        yield from sorted(_find_recordings(path)) or [path]


def _find_recordings(place: Path) -> Iterator[Path]:
    closed: list[Path] = []  # includes a path that is not a folder
    for folder, _, names in os.walk(place, onerror=lambda error: closed.append(Path(error.filename))):
        for file in (Path(folder, name) for name in names if not name.startswith(".")):
            if file.suffix.lower() in RECORDING_SUFFIXES and _is_regular_file(file):
                yield file
    yield from closed


def _is_regular_file(file: Path) -> bool:
    try:
        return file.is_file()
    except OSError:  # reading it reports the reason
        return True


def _load_settings(path: Path | None, method: str | None) -> tuple[Identification, MachineConfig | None]:
    from fdhil import config

    machine = config.load_config(path) if path is not None else None
    settings = machine.identification if machine is not None else config.Identification()
    return (settings.model_copy(update={"method": method}) if method else settings), machine


def _analyse_with_progress(
    paths: Sequence[Path],
    settings: Identification,
    machine: MachineConfig | None,
    accelerometer: Path | None,
    columns: ColumnMap | None,
    *,
    any_move: bool,
) -> list[FileResult]:
    from fdhil.cli.batch_analysis import analyse_files

    analyse = partial(
        analyse_files, paths, settings, machine, accelerometer=accelerometer, columns=columns, any_move=any_move
    )
    if not sys.stderr.isatty():
        return list(analyse())
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from fdhil.cli.printable_console import PrintableConsole

    shown = (TextColumn("identifying"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*shown, console=PrintableConsole(stderr=True), transient=True) as progress:
        task = progress.add_task("identifying", total=len(paths))
        return list(analyse(progress=partial(progress.advance, task)))


def _show_results(results: Sequence[FileResult], axes: Mapping[str, Axis], with_loops: bool) -> None:
    from rich import box
    from rich.table import Table

    from fdhil.api import count_windows_used, select_usable_estimate
    from fdhil.cli.loops_view import show_loops
    from fdhil.cli.printable_console import PrintableConsole
    from fdhil.identification import find_moving_range
    from fdhil.records import PARAMETERS

    console = PrintableConsole(highlight=False, markup=False)
    for result in results:
        if result.error is not None:
            click.echo(f"fdhil: {result.error['text']}", err=True)
            if len(results) > 1:
                console.print(f"{result.file}: not identified, it cannot be read")
            continue
        # fits a terminal of 80 columns
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        console.print(f"{result.file}: axis {result.axis}; {INTERVAL_MEANING}", style="italic")
        table.add_column("rapid\ns", no_wrap=True)
        for name in PARAMETERS:
            table.add_column(format_heading(name), justify="right", no_wrap=True)
        table.add_column("fit\n%", justify="right", no_wrap=True)
        has_table_error = any(outcome.verdict.unexplained_um is not None for outcome in result.outcomes)
        if has_table_error:  # um at the table that the model does not explain
            table.add_column("left\num", justify="right", no_wrap=True)
        table.add_column("valid", no_wrap=True)
        for outcome in result.outcomes:
            window = outcome.window
            first, last = find_moving_range(window)
            span = f"{window.start_s + first * window.dt_s:.2f}-{window.start_s + last * window.dt_s:.2f}"
            table.add_row(span, *_format_cells(select_usable_estimate(outcome), outcome.verdict, has_table_error))
        table.add_section()
        table.add_row(
            f"all {count_windows_used(result)}",
            *_format_cells(result.pooled, result.verdict, has_table_error),
            style="bold",
        )
        console.print(table)
        _show_terms(console, result)
        if (shown := result.held_out) is not None:
            text = f"  on held-out moves the model leaves at most {shown.rms_um:.3g} um RMS"
            console.print(f"{text} of {shown.following_um:.3g} um ({shown.moves} moves)")
        _show_table_errors(console, result)
        _show_reasons(console, result)
        if with_loops or result.loops is not None:
            show_loops(result, axes.get(result.axis or ""), console)


def _format_cells(estimate: Estimate | None, verdict: Verdict, has_table_error: bool) -> list[str]:
    from fdhil.records import PARAMETERS

    cells = ["-"] * len(PARAMETERS)
    if estimate is not None:
        cells = [_format_cell(estimate, name) for name in PARAMETERS]
    fit = "-" if verdict.fit_percent is None else f"{verdict.fit_percent:.2f}"
    left = "-" if verdict.unexplained_um is None else f"{verdict.unexplained_um:.3g}"
    return [*cells, fit, *([left] if has_table_error else []), "yes" if verdict.accepted else "no"]


def _format_cell(estimate: Estimate, name: str) -> str:
    if name in estimate.given and name != "K":
        return "-"  # from the data sheet, not determined by this recording
    value, half = estimate.get_value(name), INTERVAL_95 * estimate.get_std(name)
    return (
        format_cell(name, value, None).replace("(no ±)", "(given)")
        if name in estimate.given
        else format_cell(name, value, half)
    )


def _show_terms(console: Any, result: FileResult) -> None:
    from fdhil.api import select_usable_estimate

    each = ((f"{o.window.start_s:.2f} s", select_usable_estimate(o)) for o in result.outcomes)
    for who, estimate in each if result.pooled is None else (("all", result.pooled),):
        if estimate is not None and estimate.terms:
            cells = (
                format_cell(n, estimate.get_value(n), INTERVAL_95 * estimate.get_std(n), " ") for n in estimate.terms
            )
            named = (f"{n} {value} {get_unit(n)}" for n, value in zip(estimate.terms, cells, strict=True))
            console.print(f"  terms of {who}: {', '.join(named)}")


def _show_table_errors(console: Any, result: FileResult) -> None:
    for outcome in result.outcomes:
        if (seen := outcome.at_table) is not None:
            left = "" if seen.left_rms_um is None else f"; {seen.left_rms_um:.3g} um RMS of it not predicted"
            console.print(
                f"  table from {outcome.window.start_s:.2f} s: error {seen.error_rms_um:.3g} um RMS, at most "
                f"{seen.error_max_um:.3g}; {seen.unseen_rms_um:.3g} um RMS of it unseen by the drive's encoder{left}"
            )


def _show_reasons(console: Any, result: FileResult) -> None:
    from fdhil.api import describe_voltage_delay
    from fdhil.validation import collect_signal_warnings

    verdicts = [*(outcome.verdict for outcome in result.outcomes), result.verdict]
    reasons = [r for verdict in verdicts for r in (*verdict.reasons, *verdict.warnings)]
    reasons += [r for outcome in result.outcomes for r in collect_signal_warnings(outcome.window)]
    for outcome in result.outcomes:
        delay = describe_voltage_delay(outcome.estimate) if outcome.window.slow_voltage is not None else None
        if delay is not None:
            late_ms, half_ms = 1e3 * delay["value"], 1e3 * INTERVAL_95 * delay["std"]
            text = f"  voltage is delayed by {late_ms:.3f} ± {half_ms:.3f} ms from {outcome.window.start_s:.2f} s on"
            console.print(text)
    for reason in dict.fromkeys(reasons):
        advice = f"; {reason.advice}" if reason.advice else ""
        console.print(f"  {reason}{advice}")
