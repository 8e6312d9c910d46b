"""``fdhil uplink`` sends the records of a machine; ``fdhil fleet`` collects and compares those of all machines."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.cli_errors import SuggestingGroup, require_delivered_answer
from fdhil.cli.options import AS_JSON, CONFIG, FLEET, LINES
from fdhil.errors import FdhilError

if TYPE_CHECKING:
    from fdhil.config import Fleet

BY = click.option("--by", default="type", show_default=True, help="Label of [uplink] that groups comparable machines.")
ELSEWHERE: Mapping[str, str] = {
    **dict.fromkeys(("service", "services", "retain", "export", "web", "web-user"), "fdhil.cli.fleet_admin_commands"),
    **dict.fromkeys(("key", "sign", "stage"), "fdhil.cli.fleet_rollout_commands"),
    "reanalyse": "fdhil.cli.fleet_reanalyse_command",
}
PARAMETER = click.Choice(("R", "L", "K", "Jt", "ft", "Cd"))


@contextmanager
def require_fleet_extra() -> Iterator[None]:
    """Report a missing library of the extra ``fleet`` as FdhilError."""
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

    Runs as a separate process that reads the store, so the daemon never waits for it. Records made while the server is
    unreachable are sent later, each once and in order. [uplink] of CONFIG names the server; without it nothing is sent
    or queued. Stops on SIGTERM or Ctrl-C.
    """
    from fdhil import config as machine_config

    machine = machine_config.load_config(config)
    with require_fleet_extra():
        from fdhil.fleet import send_records
    from fdhil.daemon import write_lines_as_json
    from fdhil.shopfloor import report_ready, run_publisher

    with write_lines_as_json(as_json):
        run_publisher(lambda machine: send_records(machine, report_ready), machine)


class FleetGroup(SuggestingGroup):
    """The group ``fleet``; imports the modules of its larger commands on call."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return [*super().list_commands(ctx), *ELSEWHERE]

    def find_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return one command, or None if the name is unknown."""
        if cmd_name not in ELSEWHERE:
            return super().find_command(ctx, cmd_name)
        command: click.Command = getattr(import_module(ELSEWHERE[cmd_name]), cmd_name.replace("-", "_"))
        return command


@click.group(cls=FleetGroup)
def fleet() -> None:
    """Collect and compare the histories of many machines.

    FLEET is the configuration of the fleet server (TOML): NATS server, PostgreSQL database, folder of the windows.
    Needs the extra 'fleet'.
    """


@fleet.command()
@FLEET
@LINES
def collect(fleet: Path, as_json: bool) -> None:
    """Collect the machines' records in the database of FLEET.

    Reads them from JetStream. Several collectors may run, on one or more computers. Creates stream and tables if they
    are missing. Stops on SIGTERM or Ctrl-C.
    """
    from fdhil.config import load_fleet_config

    settings = load_fleet_config(fleet)
    with require_fleet_extra():
        from fdhil.fleet import collect_records as gather
    from fdhil.daemon import write_lines_as_json
    from fdhil.shopfloor import report_ready, run_publisher

    with write_lines_as_json(as_json):
        run_publisher(lambda settings: gather(settings, report_ready), settings)


def query_database(settings: "Fleet", question: str, **given: str | None) -> dict[str, Any]:
    """Return the answer of the database to a question, which is the name of a command."""
    with require_fleet_extra():
        from fdhil.fleet import QUERIES, open_read_only
    with open_read_only(settings) as db:
        return QUERIES[question](db, **given)


def query_and_print(fleet: Path, question: str, as_json: bool, **given: str | None) -> dict[str, Any]:
    """Answer a question from the database of ``fleet``, and print the answer."""
    from fdhil.cli import fleet_view
    from fdhil.config import load_fleet_config

    answer = query_database(load_fleet_config(fleet), question, **given)
    fleet_view.print_answer(answer, question, as_json)
    return answer


@fleet.command()
@FLEET
@AS_JSON
def status(fleet: Path, as_json: bool) -> None:
    """Show the status and the due maintenance of all machines.

    Lists the time of the last record, missing records, pending notices and parameter revisions of each.
    """
    query_and_print(fleet, "status", as_json)


@fleet.command()
@FLEET
@click.option("--machine", required=True, help="Fleet name of the machine.")
@click.option("--axis", required=True, help="Axis letter.")
@click.option("--parameter", required=True, type=PARAMETER, help="Parameter to show.")
@AS_JSON
@require_delivered_answer
def trend(fleet: Path, machine: str, axis: str, parameter: str, as_json: bool) -> int:
    """Show the history of one parameter of one axis.

    Includes temperature, 95 % interval and slope per 30 days.
    """
    answer = query_and_print(fleet, "trend", as_json, machine=machine, axis=axis, parameter=parameter)
    return 0 if answer["sets"] else 1


@fleet.command()
@FLEET
@click.option("--parameter", required=True, type=PARAMETER, help="Parameter to compare.")
@BY
@click.option("--axis", help="Restrict to one axis letter.")
@AS_JSON
def compare(fleet: Path, parameter: str, by: str, axis: str | None, as_json: bool) -> None:
    """Compare one parameter of the same axis across machines.

    Groups the machines by a label of [uplink].
    """
    query_and_print(fleet, "compare", as_json, parameter=parameter, by=by, axis=axis)


@fleet.command()
@FLEET
@BY
@click.option("--axis", help="Restrict to one axis letter.")
@AS_JSON
@require_delivered_answer
def outliers(fleet: Path, by: str, axis: str | None, as_json: bool) -> int:
    """List the axes that differ from comparable axes.

    Comparable axes (peers) are the same axis of machines with the same label; at least five are needed. Temperature
    and age since the first set or the newest service are taken into account. The false-alarm rate is one in a hundred
    groups per parameter.
    """
    answer = query_and_print(fleet, "outliers", as_json, by=by, axis=axis)
    return 1 if answer["outliers"] else 0
