"""``fdhil run``, ``status``, ``arm`` and ``disarm``: the daemon, and talking to it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import click

from fdhil import config as machine_config
from fdhil import tables

CONFIG = click.argument("config", type=click.Path(path_type=Path))
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Write one JSON document.")


def run_directory(config: machine_config.MachineConfig) -> Path:
    """Return the folder of the daemon's socket and token."""
    return config.store.run_directory or config.store.directory / "run"


@click.command()
@CONFIG
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Left out: the config's, else the best.")
@click.option("--json", "as_json", is_flag=True, help="Write each line as a JSON object to stdout.")
def run(config: Path, method: str | None, as_json: bool) -> None:
    """Run the daemon of the machine in CONFIG: listen, identify, predict; correct only when armed.

    Writes one line per outcome to stderr, with --json to stdout. Stops on SIGTERM or Ctrl-C, with the correction ramped
    to zero first.
    """
    machine = machine_config.load(config)
    from fdhil.cli.compiling import forewarn
    from fdhil.daemon import journal, service  # late: --help imports nothing heavy
    from fdhil.drivers import open_machine

    forewarn("identify", "predict", "correct")
    with journal.lines_as_json(as_json):
        service.run(machine, open_machine, method)


def _ask(
    config: Path,
    request: Mapping[str, Any],
    timeout_s: float = 10.0,
    progress: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    machine = machine_config.load(config)
    from fdhil.daemon.control import SOCKET_NAME, ask

    return ask(run_directory(machine) / SOCKET_NAME, request, timeout_s, progress)


@click.command()
@CONFIG
@AS_JSON
def status(config: Path, as_json: bool) -> None:
    """Ask the running daemon of CONFIG how it is: parameters, windows, frames, guard, notices."""
    answer = _ask(config, {"request": "status"})
    if as_json:
        click.echo(json.dumps(answer))
        return
    from fdhil.cli.status_view import show

    show(answer)


@click.command()
@CONFIG
@click.argument("program", type=click.Path(path_type=Path), required=False)
@click.option("--method", type=click.Choice(list(tables.CORRECTIONS)), help="Left out: the best there is.")
@click.option("--whole", is_flag=True, help="Arm only when all of a long PROGRAM has passed, however long that takes.")
@AS_JSON
def arm(config: Path, program: Path | None, method: str | None, whole: bool, as_json: bool) -> None:
    """Arm the correction of one PROGRAM (or demand CSV) on the machine of CONFIG.

    Without PROGRAM, --method flatness feeds speed and torque forward on line, whatever runs.

    A program longer than 10 s is armed when all of it, or its first minute, has passed the check, which then goes on
    ahead of the motion: what it refuses later is told at least a minute ahead, and the correction ramped to zero before
    that place. How far the check is goes to stderr (with --json one JSON object per line); Ctrl-C abandons it. What was
    checked is not checked again until program, parameters or config change.

    Exit 1 with class, cause and next action when it is refused. Nothing is armed again by itself, ever.
    """
    if program is None and method != "flatness":
        raise click.UsageError("only --method flatness needs no PROGRAM; name the program to correct")
    machine = machine_config.load(config)
    if program is not None:
        with program.open("rb"):  # a file that is not there is trouble, not the daemon's no
            pass
    from fdhil.daemon.token import read_token

    request = {
        "request": "arm",
        "program": None if program is None else str(program.resolve()),
        "method": method,
        "whole": whole,
        "token": read_token(run_directory(machine)),
    }
    shown = _Shown(as_json)
    answer = _ask(config, request, 600.0, shown)
    shown.end()
    _tell(answer, as_json)


class _Shown:
    """The progress of a check on stderr: one line that is written over, or JSON lines."""

    def __init__(self, as_json: bool) -> None:
        self._as_json, self._open = as_json, False

    def __call__(self, told: Mapping[str, Any]) -> None:
        if self._as_json:
            click.echo(json.dumps({"progress": told}), err=True)
            return
        minutes, seconds = divmod(int(told["checked_s"]), 60)
        text = f"checked {minutes}:{seconds:02d} of the program, line {told['line']}"
        text += f", {told['times_real_time']:.0f} x real time"
        if told["refused"]:
            text += f", {told['refused']} places refused"
        click.echo(f"\r{text:<78}", err=True, nl=False)
        self._open = True

    def end(self) -> None:
        """Begin a new line where one is open."""
        if self._open:
            click.echo(err=True)


@click.command()
@CONFIG
@AS_JSON
def disarm(config: Path, as_json: bool) -> None:
    """Ramp the correction to zero and disarm."""
    _tell(_ask(config, {"request": "disarm"}), as_json)


def _tell(answer: Mapping[str, Any], as_json: bool) -> None:
    """Show an answer; exit 1 when it is no."""
    if as_json:
        click.echo(json.dumps(answer))
    elif answer["ok"]:
        click.echo(answer.get("text", "done"))
    else:
        advice = f"; {answer['advice']}" if answer.get("advice") else ""
        click.echo(f"refused: {answer['code']}: {answer['text']}{advice}", err=True)
        for more in answer.get("refused", [])[1:]:
            if isinstance(more, str):
                click.echo(f"also: {more}", err=True)
    if not answer["ok"]:
        click.get_current_context().exit(1)
