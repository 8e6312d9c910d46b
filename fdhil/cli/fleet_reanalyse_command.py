"""``fdhil fleet reanalyse``: repeat the analysis of all stored windows and report the changes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fdhil import tables
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.fleet_commands import BY, require_fleet_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET

if TYPE_CHECKING:
    from fdhil.config import MachineConfig

UNREADABLE = 3
DAY = click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S"])


@click.command()
@FLEET
@click.option("--since", type=DAY, help="Restrict to windows from this day on (UTC).")
@click.option("--until", type=DAY, help="Restrict to windows before this day (UTC).")
@click.option("--machine", help="Restrict to one machine, by its fleet name.")
@click.option("--axis", help="Restrict to one axis letter.")
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Estimator (default: the best).")
@click.option("--config", "configs", type=FILE, multiple=True, help="Configuration of a machine; repeatable.")
@click.option("--scheduler", help="Dask scheduler, tcp://... or tls://... (default: processes of this computer).")
@click.option(
    "--workers",
    type=click.IntRange(0, 1024),
    help="Number of processes of this computer, 0 for none (default: one per core).",
)
@BY
@AS_JSON
@require_delivered_answer
def reanalyse(
    fleet: Path,
    since: datetime | None,
    until: datetime | None,
    machine: str | None,
    axis: str | None,
    method: str | None,
    configs: tuple[Path, ...],
    scheduler: str | None,
    workers: int | None,
    by: str,
    as_json: bool,
) -> int:
    """Repeat the analysis of the stored windows of all machines.

    Reports the changes. Earlier results are kept: the new ones form a separate revision in the database, identified by
    method, configurations and code. The same call continues an interrupted run. Windows of machines whose --config is
    given are assessed with their regulators, the others with what the recordings contain. The results do not depend
    on the number of workers.
    """
    from fdhil.config import Identification, load_fleet_config

    if scheduler is not None and workers is not None:
        raise click.UsageError(
            "--workers are processes of this computer, --scheduler is a cluster; give only one of them"
        )
    settings, machines = load_fleet_config(fleet), _load_machine_configs(configs)
    with require_fleet_extra():
        from fdhil.fleet import (
            AnalysisMethod,
            WindowScope,
            compute_code_digest,
            open_read_only,
            reanalyse_windows,
            summarise_changes,
        )
        from fdhil.fleet import open_worker_pool as entered
    from fdhil.api import announce_compilation
    from fdhil.cli import fleet_reanalysis_view as view
    from fdhil.cli import fleet_view

    chosen = AnalysisMethod(
        Identification(method=method), machines, settings.objects.directory.resolve(), compute_code_digest()
    )
    scope = WindowScope(_convert_to_utc(since), _convert_to_utc(until), machine, axis)
    announce_compilation("identify")
    count = (os.cpu_count() or 1) if workers is None else workers
    with require_fleet_extra(), entered(scheduler, count) as pool, _show_progress_bar() as progress:
        revision = reanalyse_windows(settings, chosen, scope, pool, progress)
    with open_read_only(settings) as db:
        answer = summarise_changes(db, revision, by)
    fleet_view.print_answer(answer, "reanalyse", as_json, view.describe_changes)
    return UNREADABLE if answer["unreadable"] else 0


def _load_machine_configs(configs: tuple[Path, ...]) -> dict[str, MachineConfig]:
    from fdhil import config

    machines: dict[str, MachineConfig] = {}
    for path in configs:
        read = config.load_config(path)
        name = read.machine.name if read.uplink is None else read.uplink.get_plant_name(read.machine.name)
        if name in machines:
            raise click.BadParameter(f"{path} describes {name}, as another --config does", param_hint="--config")
        machines[name] = read
    return machines


def _convert_to_utc(at: datetime | None) -> datetime | None:
    return None if at is None else at.replace(tzinfo=UTC)


@contextmanager
def _show_progress_bar() -> Iterator[Callable[[int, int], None]]:
    if not sys.stderr.isatty():
        from fdhil.fleet import ignore_progress

        yield ignore_progress
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from fdhil.cli.printable_console import PrintableConsole

    shown = (TextColumn("analysing"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*shown, console=PrintableConsole(stderr=True), transient=True) as progress:
        task = progress.add_task("analysing")
        yield lambda done, total: progress.update(task, completed=done, total=total)
