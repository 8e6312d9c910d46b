"""``fdhil identify``: from recordings to parameters, each with its interval, or the reason why not."""

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
from fdhil.cli.failing import verdict
from fdhil.cli.options import AS_JSON, FILE, OutputFile, Picture, Writing
from fdhil.records import INTERVAL_95, unit_of
from fdhil.report.parameter_view import MEANING, cell, head
from fdhil.store import suffixes
from fdhil.store.output import open_output

if TYPE_CHECKING:
    from fdhil.api.analysis import FileResult
    from fdhil.config import Axis, Identification, MachineConfig
    from fdhil.records import Estimate, Verdict
    from fdhil.store.column_map import ColumnMap

PROPOSE = "?"  # of --columns
BESIDE = "-"  # of --plot without a name
UNREADABLE = 3


@click.command(cls=Writing)
@click.argument("recordings", nargs=-1, required=True, type=FILE, metavar="RECORDING...")
@click.option("--config", "config_path", type=FILE, help="Machine configuration (TOML).")
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Estimator; left out: the best one.")
@click.option(
    "--write-model",
    "model",
    type=OutputFile(".json"),
    help="Write the validated pools, with terms and loops, as a model file for --model of predict and correct.",
)
@click.option("--loops", "with_loops", is_flag=True, help="Identify the drive's own loops, too.")
@click.option(
    "--accelerometer",
    type=FILE,
    help="What an accelerometer at the table recorded of the same run (CSV, as Klipper writes it); for one RECORDING.",
)
@click.option("--any-move", is_flag=True, help="Take each recording as one move of any kind: a laboratory's.")
@click.option(
    "--report", type=OutputFile(".html"), help="Write an HTML page of one RECORDING: signals, model, residuals."
)
@click.option(
    "--plot",
    is_flag=False,
    flag_value=BESIDE,
    type=Picture(),
    help="Draw signals, model and residuals of one RECORDING (.png, .svg, .pdf); without a name next to it.",
)
@click.option(
    "--columns",
    type=FILE,
    help="Column map (TOML) of another program's file; ? proposes one from names, units and physics, and writes it.",
)
@AS_JSON
@verdict
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

    Each rapid is a window: it is checked, the six parameters are estimated from it, and the model is validated. The
    accepted windows of a file together give its pooled parameters. With --config they are also compared with the axis'
    nominal values: a sensor whose gain is wrong all along shows in no other way. A recording may have no voltage: then
    K is the one in its header torque_constant_nm_per_a, else the nominal one of --config. Where the configured
    regulators do not explain the rapids, and with --loops always, the drive's own are identified; those that explain
    more are used. A RECORDING is CSV, Parquet, MATLAB, MDF 4 or HDF5; with --columns it is what another program wrote.
    Of a folder all recordings are taken, those of its folders too; many are spread over processes.

    Voltage, current and speed are enough. A laboratory's recording (steps, ramps, chirps, a locked rotor) is taken
    whole with --any-move; what it cannot determine is null, with the reason.
    Exit codes: 0 every file's pool is validated, 1 some pool is not, 2 wrong option or configuration, 3 a recording
    cannot be read (the others are identified all the same).
    """
    recordings = tuple(_files(recordings))
    for option, value in (("--accelerometer", accelerometer), ("--report", report), ("--plot", plot)):
        if value is not None and len(recordings) > 1:
            raise click.UsageError(f"{option} belongs to one recording: give each with its own")
    if report is not None or plot is not None:
        reports.require()
    settings, machine = _settings(config_path, method)
    axes = machine.axis if machine is not None else {}
    column_map = _column_map(columns, recordings, as_json=as_json)
    if columns is not None and column_map is None:
        return 1
    results = _analyse(recordings, settings, machine, accelerometer, column_map, any_move=any_move)
    from fdhil.api.analysis import compare_with_data_sheet
    from fdhil.api.documents import identification_document

    if machine is not None:
        results = [compare_with_data_sheet(result, axes) for result in results]
    if with_loops:
        from fdhil.api.loops import with_all_loops

        results = with_all_loops(results, settings, machine)
    if model is not None:
        from fdhil.cli.model_file import write_model

        write_model(results, axes, model)
    _draw(results[0], report, plot)
    if as_json:
        click.echo(json.dumps(identification_document(results, axes, with_loops=with_loops), allow_nan=False))
    else:
        _show(results, axes, with_loops)
    if any(result.error for result in results):
        return UNREADABLE
    return 0 if all(r.verdict.accepted for r in results) else 1


def _column_map(columns: Path | None, recordings: Sequence[Path], *, as_json: bool) -> ColumnMap | None:
    """Read the map; with ``?`` propose one, write it next to the recording and ask. None where it is to be checked."""
    from fdhil.store.column_map import read_column_map

    if columns is None:
        return None
    if str(columns) != PROPOSE:
        return read_column_map(columns)
    from fdhil.store.column_proposal import propose_columns

    proposal = propose_columns(recordings[0])
    path = recordings[0].with_suffix(".columns.toml")
    if path.exists():
        raise click.UsageError(f"{path} exists and is left as it is: give it with --columns, or remove it")
    with open_output(path) as file:
        file.write(proposal.toml.encode())
    for line in proposal.lines():
        click.echo(line, err=True)
    click.echo(f"proposed column map: {path}", err=True)
    faults = proposal.faults
    if faults or as_json or not sys.stdin.isatty():
        what = f"It lacks {'; '.join(faults)}. " if faults else ""
        click.echo(f"{what}Check it, then: fdhil identify {recordings[0]} --columns {path}", err=True)
        return None
    return read_column_map(path) if click.confirm("Identify with it?", err=True) else None


def _draw(result: FileResult, report: Path | None, plot: Path | None) -> None:
    """Write the page and the picture of one recording where they were asked for."""
    if result.error is not None or (report is None and plot is None):
        return
    from fdhil.report.identification import identification_page, save_picture

    if report is not None:
        reports.write(identification_page(result), report)
    if plot is not None:
        save_picture(result, Path(result.file).with_suffix(".png") if str(plot) == BESIDE else plot)


def _files(recordings: Sequence[Path]) -> Iterator[Path]:
    """Yield the files, of a folder all that are named as recordings are.

    A folder that has none, or cannot be looked into, is yielded itself: who reads it tells why.
    """
    for path in recordings:
        yield from sorted(_within(path)) or [path]


def _within(place: Path) -> Iterator[Path]:
    closed: list[Path] = []  # also a place that is no folder
    for folder, _, names in os.walk(place, onerror=lambda error: closed.append(Path(error.filename))):
        for file in (Path(folder, name) for name in names if not name.startswith(".")):
            if file.suffix.lower() in suffixes.RECORDINGS and _may_be_read(file):
                yield file
    yield from closed


def _may_be_read(file: Path) -> bool:
    """Whether it is a regular file, as far as this user may know."""
    try:
        return file.is_file()
    except OSError:  # reading it tells why
        return True


def _settings(path: Path | None, method: str | None) -> tuple[Identification, MachineConfig | None]:
    from fdhil import config

    machine = config.load(path) if path is not None else None
    settings = machine.identification if machine is not None else config.Identification()
    return (settings.model_copy(update={"method": method}) if method else settings), machine


def _analyse(
    paths: Sequence[Path],
    settings: Identification,
    machine: MachineConfig | None,
    accelerometer: Path | None,
    columns: ColumnMap | None,
    *,
    any_move: bool,
) -> list[FileResult]:
    from fdhil.cli.batch import analyse_files

    analyse = partial(
        analyse_files, paths, settings, machine, accelerometer=accelerometer, columns=columns, any_move=any_move
    )
    if not sys.stderr.isatty():
        return list(analyse())
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from fdhil.cli.console import PrintableConsole

    shown = (TextColumn("identifying"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*shown, console=PrintableConsole(stderr=True), transient=True) as progress:
        task = progress.add_task("identifying", total=len(paths))
        return list(analyse(progress=partial(progress.advance, task)))


def _show(results: Sequence[FileResult], axes: Mapping[str, Axis], with_loops: bool) -> None:
    from rich import box
    from rich.table import Table

    from fdhil.api.documents import usable_estimate, windows_used
    from fdhil.cli.console import PrintableConsole
    from fdhil.cli.loops_view import show_loops
    from fdhil.identification.windows import moving_range
    from fdhil.records import PARAMETERS

    console = PrintableConsole()
    for result in results:
        if result.error is not None:
            click.echo(f"fdhil: {result.error['text']}", err=True)
            if len(results) > 1:
                console.print(f"{result.file}: not identified, it cannot be read", highlight=False, markup=False)
            continue
        # a terminal of 80 columns holds all of it
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        console.print(f"{result.file}: axis {result.axis}; {MEANING}", style="italic", highlight=False, markup=False)
        table.add_column("rapid\ns", no_wrap=True)
        for name in PARAMETERS:
            table.add_column(head(name), justify="right", no_wrap=True)
        table.add_column("fit\n%", justify="right", no_wrap=True)
        weighed = any(outcome.verdict.unexplained_um is not None for outcome in result.outcomes)
        if weighed:  # micrometres at the table that the model leaves of the rapid
            table.add_column("left\num", justify="right", no_wrap=True)
        table.add_column("valid", no_wrap=True)
        for outcome in result.outcomes:
            window = outcome.window
            first, last = moving_range(window)
            span = f"{window.start_s + first * window.dt_s:.2f}-{window.start_s + last * window.dt_s:.2f}"
            table.add_row(span, *_cells(usable_estimate(outcome), outcome.verdict, weighed))
        table.add_section()
        table.add_row(f"all {windows_used(result)}", *_cells(result.pooled, result.verdict, weighed), style="bold")
        console.print(table)
        _show_terms(console, result)
        if (shown := result.held_out) is not None:
            text = f"  of moves that it was not identified on the model leaves {shown.rms_um:.3g} um RMS at most"
            console.print(
                f"{text} ({shown.moves} moves, of {shown.following_um:.3g} um)", highlight=False, markup=False
            )
        _show_table(console, result)
        _show_reasons(console, result)
        if with_loops or result.loops is not None:
            show_loops(result, axes.get(result.axis or ""), console)


def _cells(estimate: Estimate | None, verdict: Verdict, weighed: bool) -> list[str]:
    from fdhil.records import PARAMETERS

    cells = ["-"] * len(PARAMETERS)
    if estimate is not None:
        cells = [_cell(estimate, name) for name in PARAMETERS]
    fit = "-" if verdict.fit_percent is None else f"{verdict.fit_percent:.2f}"
    left = "-" if verdict.unexplained_um is None else f"{verdict.unexplained_um:.3g}"
    return [*cells, fit, *([left] if weighed else []), "yes" if verdict.accepted else "no"]


def _cell(estimate: Estimate, name: str) -> str:
    if name in estimate.given and name != "K":
        return "-"  # of the data sheet, and no answer of this recording
    value, half = estimate.value(name), INTERVAL_95 * estimate.std(name)
    return cell(name, value, None).replace("(no ±)", "(given)") if name in estimate.given else cell(name, value, half)


def _show_terms(console: Any, result: FileResult) -> None:
    from fdhil.api.documents import usable_estimate

    each = ((f"{o.window.start_s:.2f} s", usable_estimate(o)) for o in result.outcomes)
    for who, estimate in each if result.pooled is None else (("all", result.pooled),):
        if estimate is not None and estimate.terms:
            told = (cell(n, estimate.value(n), INTERVAL_95 * estimate.std(n), " ") for n in estimate.terms)
            named = (f"{n} {value} {unit_of(n)}" for n, value in zip(estimate.terms, told, strict=True))
            console.print(f"  terms of {who}: {', '.join(named)}", highlight=False, markup=False)


def _show_table(console: Any, result: FileResult) -> None:
    for outcome in result.outcomes:
        if (seen := outcome.at_table) is not None:
            left = "" if seen.left_rms_um is None else f"; {seen.left_rms_um:.3g} um RMS of it not predicted"
            console.print(
                f"  table from {outcome.window.start_s:.2f} s: error {seen.error_rms_um:.3g} um RMS, at most "
                f"{seen.error_max_um:.3g}; {seen.unseen_rms_um:.3g} um RMS of it unseen by the drive's encoder{left}",
                highlight=False,
                markup=False,
            )


def _show_reasons(console: Any, result: FileResult) -> None:
    """Write each reason, and what only widens the intervals, once and with what to do."""
    from fdhil.api.documents import voltage_delay
    from fdhil.validation.plausibility import warnings_of

    verdicts = [*(outcome.verdict for outcome in result.outcomes), result.verdict]
    told = [r for verdict in verdicts for r in (*verdict.reasons, *verdict.warnings)]
    told += [r for outcome in result.outcomes for r in warnings_of(outcome.window)]
    for outcome in result.outcomes:
        delay = voltage_delay(outcome.estimate) if outcome.window.slow_voltage is not None else None
        if delay is not None:
            late_ms, half_ms = 1e3 * delay["value"], 1e3 * INTERVAL_95 * delay["std"]
            text = f"  voltage is late by {late_ms:.3f} ± {half_ms:.3f} ms from {outcome.window.start_s:.2f} s on"
            console.print(text, highlight=False, markup=False)
    for reason in dict.fromkeys(told):
        advice = f"; {reason.advice}" if reason.advice else ""
        console.print(f"  {reason}{advice}", highlight=False, markup=False)
