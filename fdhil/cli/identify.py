"""``fdhil identify``: from recordings to parameters, each with its interval, or the reason why not."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import tables
from fdhil.cli.parameter_view import MEANING, cell, head
from fdhil.records import INTERVAL_95

if TYPE_CHECKING:
    from fdhil.cli.batch import FileResult
    from fdhil.config import Identification
    from fdhil.records import Estimate, Parameters, Verdict, WindowOutcome

SCHEMA = "fdhil-identify-1"
UNREADABLE = 3


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORDING...")
@click.option("--config", "config_path", type=click.Path(path_type=Path), help="Machine configuration (TOML).")
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Estimator; left out: the best there is.")
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout and nothing else.")
def identify(recordings: tuple[Path, ...], config_path: Path | None, method: str | None, as_json: bool) -> int:
    """Identify a drive from the rapid moves in each RECORDING (CSV).

    Each rapid is a window: it is checked, the six parameters are estimated from it, and the model is validated. The
    accepted windows of a file together give its pooled parameters. With --config they are also compared with the axis'
    nominal values: a sensor whose gain is wrong all along shows in no other way. Exit codes: 0 every file's pool is
    validated, 1 some pool is not, 2 wrong option or configuration, 3 a recording cannot be read (the others are
    identified all the same).
    """
    settings, rapid_speeds, nominal = _settings(config_path, method)
    results = [_against_data_sheet(r, nominal) for r in _analyse(recordings, settings, rapid_speeds)]
    if as_json:
        document = {"schema": SCHEMA, "files": [_file_document(r) for r in results]}
        click.echo(json.dumps(document, allow_nan=False))
    else:
        _show(results)
    if any(result.error for result in results):
        return UNREADABLE
    return 0 if all(r.verdict.accepted for r in results) else 1


def _settings(
    path: Path | None, method: str | None
) -> tuple[Identification, dict[str, float], Mapping[str, Parameters]]:
    from fdhil import config
    from fdhil.records import Parameters

    machine = config.load(path) if path is not None else None
    settings = machine.identification if machine is not None else config.Identification()
    speeds = {name: axis.rapid_speed_rad_s for name, axis in machine.axis.items()} if machine is not None else {}
    nominal = {n: Parameters(**a.nominal.model_dump()) for n, a in machine.axis.items()} if machine is not None else {}
    return (settings.model_copy(update={"method": method}) if method else settings), speeds, nominal


def _against_data_sheet(result: FileResult, nominal: Mapping[str, Parameters]) -> FileResult:
    """Refuse a pool that only a sensor's gain takes to the axis' nominal values."""
    from dataclasses import replace

    from fdhil.validation.data_sheet import gain_error

    sheet = nominal.get(result.axis or "")
    if sheet is None or result.pooled is None or not result.verdict.accepted:
        return result
    reason = gain_error(result.pooled, sheet)
    if reason is None:
        return result
    return replace(result, verdict=replace(result.verdict, accepted=False, reasons=(reason,)))


def _analyse(paths: Sequence[Path], settings: Identification, speeds: dict[str, float]) -> list[FileResult]:
    """Analyse the files, with a progress bar on stderr when that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from fdhil.cli.batch import analyse_files

    if not sys.stderr.isatty():
        return list(analyse_files(paths, settings, speeds))
    columns = (TextColumn("identifying"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("identifying", total=len(paths))
        return list(analyse_files(paths, settings, speeds, partial(progress.advance, task)))


def _file_document(result: FileResult) -> dict[str, Any]:
    document = {
        "file": result.file,
        "axis": result.axis,
        "windows": [_window_document(outcome) for outcome in result.outcomes],
        "pooled": {
            "parameters": _parameters(result.pooled, result.verdict),
            "validated": result.verdict.accepted,
            "windows_used": _used(result),
            "reasons": [str(reason) for reason in result.verdict.reasons],
        },
    }
    return document if result.error is None else document | {"error": result.error}


def _used(result: FileResult) -> int:
    if result.pooled is None:
        return 0
    return sum(outcome.verdict.accepted for outcome in result.outcomes)


def _window_document(outcome: WindowOutcome) -> dict[str, Any]:
    from fdhil.identification.windows import moving_range

    window = outcome.window
    first, last = moving_range(window)
    delay = _delay(outcome.estimate)
    return {
        "start_s": round(window.start_s + first * window.dt_s, 6),
        "end_s": round(window.start_s + last * window.dt_s, 6),
        "direction": window.direction,
        "parameters": _parameters(outcome.estimate, outcome.verdict),
        "validated": outcome.verdict.accepted,
        "fit_percent": outcome.verdict.fit_percent,
        "reasons": [str(reason) for reason in outcome.verdict.reasons],
    } | ({"delay_s": delay} if delay is not None else {})


def _delay(estimate: Estimate | None) -> dict[str, Any] | None:
    """Return by how much the voltage is late against current and speed; None where that was not estimated."""
    if estimate is None or estimate.delay_s is None or estimate.delay_std_s is None:
        return None
    if not (math.isfinite(estimate.delay_s) and math.isfinite(estimate.delay_std_s)):
        return None
    return {"value": estimate.delay_s, "std": estimate.delay_std_s, "unit": "s"}


def _parameters(estimate: Estimate | None, verdict: Verdict) -> dict[str, Any]:
    """Return value, std and unit of each parameter, or null and the reason."""
    from fdhil.records import PARAMETERS, UNITS

    answer: dict[str, Any] = {}
    for name in PARAMETERS:
        if estimate is not None and math.isfinite(estimate.value(name)) and math.isfinite(estimate.std(name)):
            answer[name] = {"value": estimate.value(name), "std": estimate.std(name), "unit": UNITS[name]}
            continue
        reason = estimate.missing.get(name) if estimate is not None else None
        reason = reason or (verdict.reasons[0] if verdict.reasons else None)
        answer[name] = {"value": None, "reason": str(reason) if reason is not None else "NotFinite: no estimate"}
    return answer


def _show(results: Sequence[FileResult]) -> None:
    """Write a table per file for people: every window, then the pool."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from fdhil.identification.windows import moving_range
    from fdhil.records import PARAMETERS

    console = Console()
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
        table.add_column("valid", no_wrap=True)
        for outcome in result.outcomes:
            window = outcome.window
            first, last = moving_range(window)
            span = f"{window.start_s + first * window.dt_s:.2f}-{window.start_s + last * window.dt_s:.2f}"
            table.add_row(span, *_cells(outcome.estimate, outcome.verdict))
        table.add_section()
        table.add_row(f"all {_used(result)}", *_cells(result.pooled, result.verdict), style="bold")
        console.print(table)
        _show_reasons(console, result)


def _cells(estimate: Estimate | None, verdict: Verdict) -> list[str]:
    from fdhil.records import PARAMETERS

    cells = ["-"] * len(PARAMETERS)
    if estimate is not None:
        cells = [cell(name, estimate.value(name), INTERVAL_95 * estimate.std(name)) for name in PARAMETERS]
    fit = "-" if verdict.fit_percent is None else f"{verdict.fit_percent:.2f}"
    return [*cells, fit, "yes" if verdict.accepted else "no"]


def _show_reasons(console: Any, result: FileResult) -> None:
    """Write each reason, and what only widens the intervals, once and with what to do."""
    from fdhil.validation.plausibility import warnings_of

    told = [r for outcome in result.outcomes for r in outcome.verdict.reasons] + list(result.verdict.reasons)
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
