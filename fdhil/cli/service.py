"""``fdhil run``, ``status``, ``arm`` and ``disarm``: the daemon, and talking to it."""

from __future__ import annotations

import json
from collections.abc import Mapping
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
def run(config: Path, method: str | None) -> None:
    """Run the daemon of the machine in CONFIG: listen, identify, predict; correct only when armed.

    Writes one line per outcome to stderr. Stops on SIGTERM or Ctrl-C, with the correction ramped to zero first.
    """
    machine = machine_config.load(config)
    from fdhil.daemon import service  # late: --help imports nothing heavy
    from fdhil.drivers import open_machine

    service.run(machine, open_machine, method)


def _ask(config: Path, request: Mapping[str, Any], timeout_s: float = 10.0) -> dict[str, Any]:
    machine = machine_config.load(config)
    from fdhil.daemon.control import SOCKET_NAME, ask

    return ask(run_directory(machine) / SOCKET_NAME, request, timeout_s)


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
@AS_JSON
def arm(config: Path, program: Path | None, method: str | None, as_json: bool) -> None:
    """Arm the correction of one PROGRAM (or demand CSV) on the machine of CONFIG.

    Without PROGRAM, --method flatness feeds speed and torque forward on line, whatever runs.

    Exit 1 with class, cause and next action when it is refused. Nothing is armed again by itself, ever.
    """
    if program is None and method != "flatness":
        raise click.UsageError("only --method flatness needs no PROGRAM; name the program to correct")
    machine = machine_config.load(config)
    from fdhil.daemon.token import read_token

    request = {
        "request": "arm",
        "program": None if program is None else str(program.resolve()),
        "method": method,
        "token": read_token(run_directory(machine)),
    }
    _tell(_ask(config, request, timeout_s=600.0), as_json)


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
    if not answer["ok"]:
        click.get_current_context().exit(1)
