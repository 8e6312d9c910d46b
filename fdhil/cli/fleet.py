"""``fdhil uplink``: sends a machine's records to the works; ``fdhil fleet``: gathers them, and asks all machines."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from fdhil.cli.failing import SuggestingGroup, verdict
from fdhil.cli.options import AS_JSON, CONFIG, FLEET, LINES
from fdhil.errors import FdhilError

BY = click.option("--by", default="type", show_default=True, help="The label by which machines are of one kind.")
ELSEWHERE: Mapping[str, str] = {
    **dict.fromkeys(("service", "services", "retain", "export", "web", "web-user"), "fdhil.cli.fleet_works"),
    **dict.fromkeys(("key", "sign", "stage"), "fdhil.cli.fleet_rollout"),
    "reanalyse": "fdhil.cli.fleet_reanalysis",
}
PARAMETER = click.Choice(("R", "L", "K", "Jt", "ft", "Cd"))


@contextmanager
def with_extra() -> Iterator[None]:
    """Turn a library that is missing into a sentence."""
    try:
        yield
    except ImportError as error:
        what = f"this needs the library {error.name}, which is not installed"
        raise FdhilError(f"{what}: pip install 'fdhil[fleet]'") from None


@click.command()
@CONFIG
@LINES
def uplink(config: Path, as_json: bool) -> None:
    """Send the records of CONFIG's daemon to the fleet server, over NATS JetStream.

    A process of its own that reads the store: the daemon never waits for it, and what is recorded while the server is
    away is sent later, each record once and in its order. [uplink] of CONFIG says where to; without it nothing is sent,
    and nothing is kept for it. Stops on SIGTERM or Ctrl-C.
    """
    from fdhil import config as machine_config

    machine = machine_config.load(config)
    with with_extra():
        from fdhil.fleet.uplink import send
    from fdhil.daemon import journal
    from fdhil.shopfloor.process import run, say_ready

    with journal.lines_as_json(as_json):
        run(lambda machine: send(machine, say_ready), machine)


class Questions(SuggestingGroup):
    """A group whose larger commands are in files of their own, imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return all commands."""
        return [*super().list_commands(ctx), *ELSEWHERE]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command; None for an unknown name."""
        if cmd_name not in ELSEWHERE:
            return super().get_command(ctx, cmd_name)
        command: click.Command = getattr(import_module(ELSEWHERE[cmd_name]), cmd_name.replace("-", "_"))
        return command


@click.group(cls=Questions)
def fleet() -> None:
    """Collect and compare the histories of many machines.

    FLEET is a file of the works, not of a machine: which NATS server, which PostgreSQL database, where windows are
    kept. Needs the extra 'fleet'.
    """


@fleet.command()
@FLEET
@LINES
def collect(fleet: Path, as_json: bool) -> None:
    """Collect the machines' records in the database of FLEET.

    It comes from JetStream. Any number of these may run, on one computer or several. Makes the stream and the tables
    where there are none yet. Stops on SIGTERM or Ctrl-C.
    """
    from fdhil.config.fleet import load

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet.collector import collect as gather
    from fdhil.daemon import journal
    from fdhil.shopfloor.process import run, say_ready

    with journal.lines_as_json(as_json):
        run(lambda settings: gather(settings, say_ready), settings)


def _answer(fleet: Path, question: str, **given: str | None) -> dict[str, Any]:
    from fdhil.config.fleet import load

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import questions, sets
    with sets.asking(settings) as db:
        answer: dict[str, Any] = questions.QUERIES[question](db, **given)
    return answer


@fleet.command()
@FLEET
@AS_JSON
def status(fleet: Path, as_json: bool) -> None:
    """Show all machines and their due maintenance.

    When each was heard, which records are missing, how many notices wait, its parameters.
    """
    from fdhil.cli import fleet_view

    told = _answer(fleet, "status")
    fleet_view.tell(told, "status", as_json, fleet_view.status)


@fleet.command()
@FLEET
@click.option("--machine", required=True, help="The machine, by its name in the works.")
@click.option("--axis", required=True, help="Its axis.")
@click.option("--parameter", required=True, type=PARAMETER)
@AS_JSON
@verdict
def trend(fleet: Path, machine: str, axis: str, parameter: str, as_json: bool) -> int:
    """Show the history of one parameter of one axis.

    With its slope per 30 days. Exit 1 when nothing is known of it.
    """
    from fdhil.cli import fleet_view

    told = _answer(fleet, "trend", machine=machine, axis=axis, parameter=parameter)
    fleet_view.tell(told, "trend", as_json, fleet_view.trend)
    return 0 if told["sets"] else 1


@fleet.command()
@FLEET
@click.option("--parameter", required=True, type=PARAMETER)
@BY
@click.option("--axis", help="One axis letter only.")
@AS_JSON
def compare(fleet: Path, parameter: str, by: str, axis: str | None, as_json: bool) -> None:
    """Show one parameter of the same axis of all machines.

    Side by side, by a label of [uplink].
    """
    from fdhil.cli import fleet_view

    told = _answer(fleet, "compare", parameter=parameter, by=by, axis=axis)
    fleet_view.tell(told, "compare", as_json, fleet_view.compare)


@fleet.command()
@FLEET
@BY
@click.option("--axis", help="One axis letter only.")
@AS_JSON
@verdict
def outliers(fleet: Path, by: str, axis: str | None, as_json: bool) -> int:
    """List the axes that differ from comparable axes.

    Exit 1 when there are some. Sisters are the same axis of machines with the same label; at least five are needed.
    Temperature and age, since the first set or the newest service, are taken into account. Of a hundred groups without
    an outlier one has an alarm, for each parameter.
    """
    from fdhil.cli import fleet_view

    told = _answer(fleet, "outliers", by=by, axis=axis)
    fleet_view.tell(told, "outliers", as_json, fleet_view.outliers)
    return 1 if told["outliers"] else 0
