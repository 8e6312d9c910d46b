"""``fdhil identify``: from recordings to parameters, each with its interval, or the reason why not."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import tables
from fdhil.cli.failing import verdict
from fdhil.cli.options import AS_JSON, COLUMNS, FILE, OutputFile, Writing
from fdhil.records import INTERVAL_95, unit_of
from fdhil.report.parameter_view import MEANING, cell, head
from fdhil.store import suffixes

if TYPE_CHECKING:
    from fdhil.cli.batch import FileResult
    from fdhil.config import Axis, Identification, MachineConfig
    from fdhil.records import Estimate, Verdict, WindowOutcome

SCHEMA = "fdhil-identify-1"
UNREADABLE = 3


@click.command(cls=Writing)
@click.argument("recordings", nargs=-1, required=True, type=FILE, metavar="RECORDING...")
@click.option("--config", "config_path", type=FILE, help="Machine configuration (TOML).")
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Estimator; left out: the best there is.")
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
@COLUMNS
@AS_JSON
@verdict
def identify(
    recordings: tuple[Path, ...],
    config_path: Path | None,
    method: str | None,
    model: Path | None,
    with_loops: bool,
    accelerometer: Path | None,
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
    Exit codes: 0 every file's pool is validated, 1 some pool is not, 2 wrong option or configuration, 3 a recording
    cannot be read (the others are identified all the same).
    """
    recordings = tuple(_files(recordings))
    if accelerometer is not None and len(recordings) > 1:
        raise click.UsageError("--accelerometer belongs to one recording: give each with its own")
    settings, machine = _settings(config_path, method)
    axes = machine.axis if machine is not None else {}
    results = _analyse(recordings, settings, machine, accelerometer, columns)
    if machine is not None:
        results = [_against_data_sheet(result, axes) for result in results]
    if with_loops:
        from fdhil.cli.loops_view import with_all_loops

        results = with_all_loops(results, settings, machine)
    if model is not None:
        from fdhil.cli.model_file import write_model

        write_model(results, axes, model)
    if as_json:
        document = {"schema": SCHEMA, "files": [_file_document(r, axes, with_loops) for r in results]}
        click.echo(json.dumps(document, allow_nan=False))
    else:
        _show(results, axes, with_loops)
    if any(result.error for result in results):
        return UNREADABLE
    return 0 if all(r.verdict.accepted for r in results) else 1


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


def _against_data_sheet(result: FileResult, axes: Mapping[str, Axis]) -> FileResult:
    """Refuse a pool that only a sensor's gain takes to the axis' nominal values; warn where there is no such axis."""
    from dataclasses import replace

    from fdhil.records import Parameters, Reason
    from fdhil.validation.data_sheet import gain_error

    verdict = result.verdict
    if result.axis is not None and result.axis not in axes:
        text = f"axis {result.axis} is not in the configuration: nothing was compared with its nominal values"
        unknown = Reason("NoSuchAxis", text, f"add [axis.{result.axis}], or give the configuration of its machine")
        return replace(result, verdict=replace(verdict, warnings=(*verdict.warnings, unknown)))
    if result.axis is None or result.pooled is None or not verdict.accepted:
        return result
    reason = gain_error(result.pooled, Parameters(**axes[result.axis].nominal.model_dump()))
    if reason is None:
        return result
    return replace(result, verdict=replace(verdict, accepted=False, reasons=(reason,)))


def _analyse(
    paths: Sequence[Path],
    settings: Identification,
    machine: MachineConfig | None,
    accelerometer: Path | None,
    columns: Path | None,
) -> list[FileResult]:
    from fdhil.cli.batch import analyse_files
    from fdhil.store.column_map import read_column_map

    told = None if columns is None else read_column_map(columns)
    if not sys.stderr.isatty():
        return list(analyse_files(paths, settings, machine, accelerometer=accelerometer, columns=told))
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from fdhil.cli.console import PrintableConsole

    shown = (TextColumn("identifying"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*shown, console=PrintableConsole(stderr=True), transient=True) as progress:
        task = progress.add_task("identifying", total=len(paths))
        return list(analyse_files(paths, settings, machine, partial(progress.advance, task), accelerometer, told))


def _file_document(result: FileResult, axes: Mapping[str, Axis], with_loops: bool) -> dict[str, Any]:
    from fdhil.cli.loops_view import compared

    document = {
        "file": result.file,
        "axis": result.axis,
        "windows": [_window_document(outcome) for outcome in result.outcomes],
        "pooled": {
            "parameters": _parameters(result.pooled, result.verdict),
            "terms": _terms(result.pooled),
            "validated": result.verdict.accepted,
            "windows_used": _used(result),
            "held_out": None if result.held_out is None else asdict(result.held_out),
            **_verdict(result.verdict),
        },
    }
    if with_loops or result.loops is not None:
        document["loops"] = compared(result.loops, axes.get(result.axis or ""))
    return document if result.error is None else document | {"error": result.error}


def _used(result: FileResult) -> int:
    if result.pooled is None:
        return 0
    return sum(outcome.verdict.accepted for outcome in result.outcomes)


def _window_document(outcome: WindowOutcome) -> dict[str, Any]:
    from fdhil.identification.windows import moving_range

    window, estimate = outcome.window, _usable(outcome)
    first, last = moving_range(window)
    delay = _delay(estimate)
    return {
        "start_s": round(window.start_s + first * window.dt_s, 6),
        "end_s": round(window.start_s + last * window.dt_s, 6),
        "direction": window.direction,
        "parameters": _parameters(estimate, outcome.verdict),
        "terms": _terms(estimate),
        "validated": outcome.verdict.accepted,
        "fit_percent": outcome.verdict.fit_percent,
        **_verdict(outcome.verdict),
        **({"delay_s": delay} if delay is not None else {}),
        **({"at_table": asdict(outcome.at_table)} if outcome.at_table is not None else {}),
    }


def _usable(outcome: WindowOutcome) -> Estimate | None:
    """Return the estimate of a window; of a validated one the drive that predict and correct take."""
    from fdhil.identification.physical_bounds import bounded

    if outcome.estimate is None or not outcome.verdict.accepted:
        return outcome.estimate
    return bounded(outcome.estimate, outcome.window.direction)


def _verdict(verdict: Verdict) -> dict[str, Any]:
    return {
        "unexplained_um": verdict.unexplained_um,
        "reasons": [str(reason) for reason in verdict.reasons],
        "warnings": [str(reason) for reason in verdict.warnings],
    }


def _terms(estimate: Estimate | None) -> dict[str, Any]:
    if estimate is None:
        return {}
    return {n: {"value": estimate.value(n), "std": estimate.std(n), "unit": unit_of(n)} for n in estimate.terms}


def _delay(estimate: Estimate | None) -> dict[str, Any] | None:
    """Return by how much the voltage is late against current and speed; None where that was not estimated."""
    if estimate is None or estimate.delay_s is None or estimate.delay_std_s is None:
        return None
    if not (math.isfinite(estimate.delay_s) and math.isfinite(estimate.delay_std_s)):
        return None
    return {"value": estimate.delay_s, "std": estimate.delay_std_s, "unit": "s"}


def _parameters(estimate: Estimate | None, verdict: Verdict) -> dict[str, Any]:
    """Return value, std and unit of each parameter, or null and the reason.

    K may be given; R and L that the data sheet gives are none that this recording tells.
    """
    from fdhil.identification.without_voltage import NO_VOLTAGE
    from fdhil.records import PARAMETERS, UNITS

    answer: dict[str, Any] = {}
    for name in PARAMETERS:
        if estimate is not None and name in estimate.given:
            told = {"value": estimate.value(name), "std": 0.0, "unit": UNITS[name]}
            answer[name] = {**told, "given": True} if name == "K" else {"value": None, "reason": str(NO_VOLTAGE)}
            continue
        if estimate is not None and math.isfinite(estimate.value(name)) and math.isfinite(estimate.std(name)):
            answer[name] = {"value": estimate.value(name), "std": estimate.std(name), "unit": UNITS[name]}
            continue
        reason = estimate.missing.get(name) if estimate is not None else None
        reason = reason or (verdict.reasons[0] if verdict.reasons else None)
        answer[name] = {"value": None, "reason": str(reason) if reason is not None else "NotFinite: no estimate"}
    return answer


def _show(results: Sequence[FileResult], axes: Mapping[str, Axis], with_loops: bool) -> None:
    from rich import box
    from rich.table import Table

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
            table.add_row(span, *_cells(_usable(outcome), outcome.verdict, weighed))
        table.add_section()
        table.add_row(f"all {_used(result)}", *_cells(result.pooled, result.verdict, weighed), style="bold")
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
    each = ((f"{o.window.start_s:.2f} s", _usable(o)) for o in result.outcomes)
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
    from fdhil.validation.plausibility import warnings_of

    verdicts = [*(outcome.verdict for outcome in result.outcomes), result.verdict]
    told = [r for verdict in verdicts for r in (*verdict.reasons, *verdict.warnings)]
    told += [r for outcome in result.outcomes for r in warnings_of(outcome.window)]
    for outcome in result.outcomes:
        delay = _delay(outcome.estimate) if outcome.window.slow_voltage is not None else None
        if delay is not None:
            late_ms, half_ms = 1e3 * delay["value"], 1e3 * INTERVAL_95 * delay["std"]
            text = f"  voltage is late by {late_ms:.3f} ± {half_ms:.3f} ms from {outcome.window.start_s:.2f} s on"
            console.print(text, highlight=False, markup=False)
    for reason in dict.fromkeys(told):
        advice = f"; {reason.advice}" if reason.advice else ""
        console.print(f"  {reason}{advice}", highlight=False, markup=False)
