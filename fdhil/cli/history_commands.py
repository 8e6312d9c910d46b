"""``fdhil replay``, ``history``, ``report`` and ``export``: evaluate and convert what was recorded."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fdhil import config as machine_config
from fdhil import tables
from fdhil.api import announce_compilation
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, COLUMNS, CONFIG, FILE, OutputFile, WritingCommand
from fdhil.errors import RecordingError
from fdhil.store import BUS_LOGS

if TYPE_CHECKING:
    from fdhil.records import Outcome, Window

HEALTH = ("slopes", "trends", "limits", "changes", "windows")


@click.command()
@click.argument("recordings", type=FILE, nargs=-1, required=True, metavar="RECORDING...")
@click.option("--config", "config", type=FILE, help="Machine configuration (default: from the recordings).")
@click.option(
    "--method",
    type=click.Choice(list(tables.ESTIMATORS)),
    help="Estimator (default: the configuration's, else the best).",
)
@AS_JSON
@require_delivered_answer
def replay(recordings: tuple[Path, ...], config: Path | None, method: str | None, as_json: bool) -> None:
    """Repeat the daemon's analysis of recorded windows (.parquet) or recordings (.csv), bit for bit.

    Windows of one axis are analysed in the given order, so that their pooling is repeated as well.
    """
    machine = machine_config.load_config(config) if config else None
    from fdhil.daemon import build_outcome_document, format_outcome

    files = []
    validated = True
    for path, outcomes in _replay_windows(recordings, machine, method):
        documents = [build_outcome_document(outcome) for outcome in outcomes]
        windows = [document for document in documents if document["kind"] == "window"]
        validated &= bool(windows) and all(document["validated"] for document in windows)
        files.append({"file": str(path), "outcomes": documents})
        for outcome in () if as_json else outcomes:
            click.echo(format_outcome(outcome)[0])
        if not windows and not as_json:
            click.echo(f"{path}: NoWindow: the file contains no rapid move")
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-replay-1", "validated": validated, "files": files}))
    if not validated:
        click.get_current_context().exit(1)


def _replay_windows(
    recordings: tuple[Path, ...], machine: machine_config.MachineConfig | None, method: str | None
) -> list[tuple[Path, list[Outcome]]]:
    from fdhil.pipeline import AxisPipeline

    pipelines: dict[str, AxisPipeline] = {}
    replayed: list[tuple[Path, list[Outcome]]] = []
    for path in recordings:
        outcomes: list[Outcome] = []
        for window in read_windows(path):
            if window.axis not in pipelines:
                settings = machine or _make_config(window)
                if window.axis not in settings.axis:
                    raise RecordingError(
                        f"{path} is of axis {window.axis}, which --config lacks; give the configuration of that machine"
                    )
                announce_compilation("identify")
                pipelines[window.axis] = AxisPipeline(window.axis, settings, method, with_skill=machine is not None)
            outcomes += pipelines[window.axis].process_record(window)
        replayed.append((path, outcomes))
    return replayed


def read_windows(path: Path) -> list[Window]:
    """Return the windows of a window file (.parquet) or of a recording. Raises RecordingError for other files."""
    if path.suffix == ".parquet":
        from fdhil.store import is_recording, read_window

        if not is_recording(path):
            return [read_window(path)]
    from fdhil.identification import find_windows
    from fdhil.store import read_recording

    return find_windows(read_recording(path))


def _make_config(window: Window) -> machine_config.MachineConfig:
    """Return a configuration from the metadata of a window; the other values are placeholders that a replay ignores."""
    unknown = dict.fromkeys(("R", "L", "K", "Jt", "ft", "Cd"), 1.0)
    gains = ("position_gain_per_s", "speed_kp", "speed_ki", "current_kp", "current_ki")
    regulators = dict.fromkeys((*gains, "current_limit_a", "voltage_limit_v"), 1.0)
    axis = {
        "screw_pitch_mm": window.pitch_mm,
        "rapid_speed_mm_s": abs(window.rapid_speed_rad_s) * window.pitch_mm / 6.283185307179586,
        "max_acceleration_mm_s2": 1.0,
        "nominal": unknown,
        "regulators": regulators,
    }
    machine = {"name": "replay", "sync_period_s": min(window.dt_s, 0.02)}
    return machine_config.parse_config({"machine": machine, "axis": {window.axis: axis}}, "recording", made_up=True)


@click.command(cls=WritingCommand)
@CONFIG
@click.option("--axis", help="Restrict to one axis.")
@click.option(
    "--plot",
    type=OutputFile(".png", ".svg", ".pdf"),
    help="Plot the parameters over time and temperature (.png, .svg, .pdf).",
)
@AS_JSON
def history(config: Path, axis: str | None, plot: Path | None, as_json: bool) -> None:
    """Show the parameter history of CONFIG's machine.

    Lists revisions, slopes, changes, maintenance dates and notices.
    """
    machine = machine_config.load_config(config)
    from fdhil.report import group_by_axis, read_history, read_notices, require_libraries

    if plot is not None:
        require_libraries()
    rows, health = read_history(machine, axis, partial(click.echo, err=True))
    notices = read_notices(machine, axis)
    if axis is not None and axis not in machine.axis and not rows:
        raise click.BadParameter(
            f"{config} has no axis {axis}; its axes are {', '.join(machine.axis)}", param_hint="--axis"
        )
    if plot is not None:
        from fdhil.cli.history_plot import write_plot

        write_plot(group_by_axis(machine, rows, health), plot)
    if as_json:
        parts = {key: {name: of_axis[key] for name, of_axis in health.items()} for key in HEALTH}
        click.echo(json.dumps({"schema": "fdhil-history-1", "revisions": rows, "notices": notices} | parts))
        return
    if not rows and not health and not notices:
        click.echo("no parameters published yet")
        return
    from fdhil.cli.history_view import show_health, show_notices
    from fdhil.cli.status_view import show_history

    if rows:
        show_history(rows)
    show_health(health)
    show_notices(notices)


@click.command(cls=WritingCommand)
@click.argument("recording", type=FILE)
@click.option("--out", required=True, type=OutputFile(), help="File to write.")
@click.option(
    "--format",
    "format_name",
    type=click.Choice([*tables.RECORDING_FORMATS, *BUS_LOGS.values()]),
    help="File format (default: by the suffix of --out, else csv).",
)
@COLUMNS
@AS_JSON
def export(recording: Path, out: Path, format_name: str | None, columns: Path | None, as_json: bool) -> None:
    """Convert RECORDING to another file format.

    RECORDING is a window file (.parquet), a recording (csv, parquet, mat, mdf4, hdf5), or a foreign file with
    --columns. A bus log (.log of the black box or of candump, .blf, .asc, .trc) is converted to another bus log. mdf4
    needs the extra 'mdf', hdf5 the extra 'hdf5'.
    """
    from fdhil.cli.export_file import export_file

    result = export_file(recording, out, format_name, columns)
    for what, happened in (("left_out", "omitted from"), ("reduced", "reduced in")):
        for kind, count in result.get(what, {}).items():
            click.echo(f"{count} {kind}: {happened} {out}", err=True)
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-export-1", "recording": str(recording), "file": str(out)} | result))


@click.command(cls=WritingCommand)
@CONFIG
@click.option("--out", required=True, type=OutputFile(), help="HTML file to write.")
@click.option("--pdf", type=OutputFile(".pdf"), help="PDF file to write as well (needs chromium).")
@AS_JSON
def report(config: Path, out: Path, pdf: Path | None, as_json: bool) -> None:
    """Write an HTML report of the history of CONFIG's machine."""
    from fdhil.report import require_libraries

    require_libraries()
    machine = machine_config.load_config(config)
    from fdhil.cli.history_report import write_report
    from fdhil.report import group_by_axis, read_history, read_notices, read_refusals

    rows, health = read_history(machine, tell=partial(click.echo, err=True))
    refused = read_refusals(machine)
    write_report(machine, group_by_axis(machine, rows, health, refused), refused, out, pdf, read_notices(machine))
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-report-1", "file": str(out), "revisions": len(rows)}))
