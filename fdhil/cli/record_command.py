"""``fdhil record``: record the demand of an air cut by listening to the bus."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, CONFIG, OutputFile, PositiveFloat, WritingCommand

if TYPE_CHECKING:
    from fdhil.drivers import DemandRecorder, Record, RecordedDemand

_SHOWN_GAPS = 5
NOTHING_MOVED = "nothing moved; start the program on the NC while the recording waits"


@click.command(cls=WritingCommand)
@CONFIG
@click.option("--out", required=True, type=OutputFile(), help="Demand CSV to write; use the suffix .csv.")
@click.option("--seconds", type=PositiveFloat(), help="Maximum duration of the recording, s.")
@click.option(
    "--rest",
    type=PositiveFloat(),
    default=2.0,
    show_default=True,
    help="Standstill that ends the recording, s; must exceed the longest dwell of the program.",
)
@click.option("--with-gaps", is_flag=True, help="Write the demand even if samples were lost, marked nan.")
@AS_JSON
@require_delivered_answer
def record(config: Path, out: Path, seconds: float | None, rest: float, with_gaps: bool, as_json: bool) -> None:
    """Record the NC's demand for CONFIG's machine during an air cut, as a demand CSV.

    Only listens; sends nothing. The recording starts with the first motion and ends by --rest, --seconds or Ctrl-C.
    Row k is r[k], the set-point of the drives at that SYNC, without offsets. If samples were lost, nothing is written
    unless --with-gaps is given.
    """
    machine = machine_config.load_config(config)
    import asyncio

    from fdhil.drivers import DemandRecorder

    recorder = DemandRecorder(machine, rest)
    asyncio.run(_record_demand(machine, recorder, seconds))
    recorded = recorder.build_demand()
    written = recorded is not None and (with_gaps or recorded.is_complete)
    if recorded is not None and written:
        from fdhil.program import write_demand_csv
        from fdhil.store import open_output

        with open_output(out) as file:
            write_demand_csv(recorded.reference, file)
    if as_json:
        click.echo(json.dumps(_build_record_document(out, recorded, written)))
    else:
        _print_recorded(recorded, written)
    if recorded is None or not recorded.is_complete:
        click.get_current_context().exit(1)


async def _record_demand(
    machine: machine_config.MachineConfig, recorder: DemandRecorder, seconds: float | None
) -> None:
    import asyncio
    import signal

    from fdhil.drivers import open_machine

    loop, stopped = asyncio.get_running_loop(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stopped.set)
    shown = None

    def feed_recorder(record: Record) -> None:
        nonlocal shown
        if not recorder.is_done:
            recorder.add_record(record)
        state = "recording" if recorder.has_moved else "waiting for a motion" if recorder.has_all_axes else None
        if state != shown:
            click.echo(f"{state} (Ctrl-C ends)", err=True)
            shown = state
        if recorder.is_done:
            stopped.set()

    async with open_machine(machine) as source:
        tasks = [asyncio.create_task(source.run(feed_recorder)), asyncio.create_task(stopped.wait())]
        await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result


def _build_record_document(out: Path, recorded: RecordedDemand | None, written: bool) -> dict[str, Any]:
    gaps = (
        []
        if recorded is None
        else [{"axis": g.axis, "first": g.first, "rows": g.stop - g.first} for g in recorded.gaps]
    )
    return {
        "schema": "fdhil-record-1",
        "file": str(out) if written else None,
        "rows": 0 if recorded is None else int(recorded.reference.time_s.size),
        "duration_s": 0.0 if recorded is None else float(recorded.reference.time_s[-1]),
        "complete": recorded is not None and recorded.is_complete,
        "gaps": gaps,
        "doubts": [NOTHING_MOVED] if recorded is None else list(recorded.doubts),
    }


def _print_recorded(recorded: RecordedDemand | None, written: bool) -> None:
    if recorded is None:
        click.echo(NOTHING_MOVED, err=True)
        return
    rows = recorded.reference.time_s.size
    click.echo(f"{rows} samples, {recorded.reference.time_s[-1]:.3f} s")
    for gap in recorded.gaps[:_SHOWN_GAPS]:
        lost, at_s = gap.stop - gap.first, recorded.reference.time_s[gap.first]
        click.echo(f"lost: {lost} samples of axis {gap.axis} at {at_s:.3f} s", err=True)
    if len(recorded.gaps) > _SHOWN_GAPS:
        click.echo(f"lost: {len(recorded.gaps) - _SHOWN_GAPS} further gaps", err=True)
    for doubt in recorded.doubts:
        click.echo(doubt, err=True)
    if not written:
        text = (
            "not written, because a demand with gaps cannot be corrected; reduce the load of this PC and record again"
        )
        click.echo(text, err=True)
