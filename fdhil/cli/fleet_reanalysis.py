"""``fdhil fleet reanalyse``: the stored windows of all machines again, and what that changed."""

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
from fdhil.cli.failing import verdict
from fdhil.cli.fleet import BY, with_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET

if TYPE_CHECKING:
    from fdhil.config import MachineConfig

UNREADABLE = 3
DAY = click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S"])


@click.command()
@FLEET
@click.option("--since", type=DAY, help="Windows from this day on (UTC) only.")
@click.option("--until", type=DAY, help="Windows before this day (UTC) only.")
@click.option("--machine", help="One machine only, by its name in the works.")
@click.option("--axis", help="One axis letter only.")
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Estimator; left out: the best one.")
@click.option("--config", "configs", type=FILE, multiple=True, help="A machine's configuration; may be given often.")
@click.option("--scheduler", help="A Dask scheduler (tcp://... or tls://...); left out: processes of this computer.")
@click.option(
    "--workers", type=click.IntRange(0, 1024), help="Processes of this computer, 0 for none; left out: one per core."
)
@BY
@AS_JSON
@verdict
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
    """Analyse the stored windows of all machines again.

    And tell what that changes. What was found before stays: the results are a revision of their own in the database,
    which belongs to the method, the configurations and the code. What is done of it is not done again, so a run that
    was stopped is gone on with by the same call. Windows of machines whose --config is given are weighed through their
    regulators, the others by what the recordings say. The bits are the same with any number of workers. Exit codes: 0
    done, 3 some window could not be read (the others are done all the same).
    """
    from fdhil.config import Identification
    from fdhil.config.fleet import load

    if scheduler is not None and workers is not None:
        raise click.UsageError("--workers are processes of this computer, --scheduler is a cluster: give one of them")
    settings, machines = load(fleet), _by_name(configs)
    with with_extra():
        from fdhil.fleet import reanalysis, sets
        from fdhil.fleet.changes import changes
        from fdhil.fleet.window_work import Method, code_digest
        from fdhil.fleet.workers import workers as entered
    from fdhil.api.compiling import forewarn
    from fdhil.cli import fleet_reanalysis_view as view
    from fdhil.cli import fleet_view

    asked = Method(Identification(method=method), machines, settings.objects.directory.resolve(), code_digest())
    scope = reanalysis.Scope(_utc(since), _utc(until), machine, axis)
    forewarn("identify")
    count = (os.cpu_count() or 1) if workers is None else workers
    with with_extra(), entered(scheduler, count) as crew, _bar() as progress:
        revision = reanalysis.reanalyse(settings, asked, scope, crew, progress)
    with sets.asking(settings) as db:
        told = changes(db, revision, by)
    fleet_view.tell(told, "reanalyse", as_json, view.changes)
    return UNREADABLE if told["unreadable"] else 0


def _by_name(configs: tuple[Path, ...]) -> dict[str, MachineConfig]:
    from fdhil import config

    machines: dict[str, MachineConfig] = {}
    for path in configs:
        read = config.load(path)
        name = read.machine.name if read.uplink is None else read.uplink.name_of(read.machine.name)
        if name in machines:
            raise click.BadParameter(f"{path} is of {name}, which another --config is of, too", param_hint="--config")
        machines[name] = read
    return machines


def _utc(at: datetime | None) -> datetime | None:
    return None if at is None else at.replace(tzinfo=UTC)


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None]]:
    if not sys.stderr.isatty():
        from fdhil.fleet.reanalysis import unseen

        yield unseen
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from fdhil.cli.console import PrintableConsole

    shown = (TextColumn("analysing"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*shown, console=PrintableConsole(stderr=True), transient=True) as progress:
        task = progress.add_task("analysing")
        yield lambda done, total: progress.update(task, completed=done, total=total)
