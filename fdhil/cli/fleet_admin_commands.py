"""``fdhil fleet``: services, retention, anonymous export and the web page of the fleet."""

from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import click

from fdhil.cli import fleet_view
from fdhil.cli.fleet_commands import query_and_print, query_database, require_fleet_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET
from fdhil.cli.terminal_text import print_progress
from fdhil.config import load_fleet_config


@click.command()
@FLEET
@click.option("--machine", required=True, help="Fleet name of the machine.")
@click.option("--axis", help="Axis letter (default: the whole machine).")
@click.option(
    "--date", "at", type=click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M"]), help="Time of the service, UTC (default: now)."
)
@click.option("--note", default="", help="Description of the work.")
@click.option("--remove", is_flag=True, help="Delete the service recorded for --date.")
@AS_JSON
def service(
    fleet: Path, machine: str, axis: str | None, at: datetime | None, note: str, remove: bool, as_json: bool
) -> None:
    """Record a service of a machine or axis.

    Age and maintenance limits count from then. fdhil fleet services shows the effect of each service.
    """
    if remove and at is None:
        raise click.UsageError("--remove needs the recorded --date")
    when = datetime.now(UTC).replace(microsecond=0) if at is None else at.replace(tzinfo=UTC)
    settings = load_fleet_config(fleet)
    with require_fleet_extra():
        from fdhil.fleet import enter_service, open_database, remove_service
    with open_database(settings) as db:
        if remove:
            answer = remove_service(db, machine, axis or "", when)
        else:
            answer = enter_service(db, machine, axis or "", when, note)
    fleet_view.print_answer(answer, "service", as_json)


@click.command()
@FLEET
@click.option("--machine", help="Restrict to one machine.")
@AS_JSON
def services(fleet: Path, machine: str | None, as_json: bool) -> None:
    """List the services and the parameters that each changed.

    Newest first, with the change from the sets before to those after and its 95 % interval.
    """
    query_and_print(fleet, "services", as_json, machine=machine)


@click.command()
@FLEET
@AS_JSON
def retain(fleet: Path, as_json: bool) -> None:
    """Delete records that [retention] of FLEET does not keep.

    Deletes whole months of records, and files of windows. Run it once a day by a timer. The first parameters of each
    axis are kept, and deleted records do not count as missing.
    """
    settings = load_fleet_config(fleet)
    with require_fleet_extra():
        from fdhil.fleet import apply_retention, open_database
    with open_database(settings) as db:
        answer = apply_retention(db, settings, datetime.now(UTC), print_progress)
    fleet_view.print_answer(answer, "retain", as_json)


@click.command()
@FLEET
@click.option("--anonymous", "folder", type=FILE, required=True, help="New folder to write, without names.")
@click.option("--label", "labels", multiple=True, help="Label of machines or axes to include; repeatable.")
@click.option("--key", type=FILE, help="Key of the names (default: anonymous.key next to FLEET, created if missing).")
@AS_JSON
def export(fleet: Path, folder: Path, labels: tuple[str, ...], key: Path | None, as_json: bool) -> None:
    """Export the machines' records without names.

    Writes Parquet files: names of machines become keyed digests, times become ages in months, texts and labels are
    omitted except for --label. The key identifies the machines; keep it secret.
    """
    settings = load_fleet_config(fleet)
    with require_fleet_extra():
        from fdhil.fleet import export_tables, load_or_create_key, open_read_only
    with open_read_only(settings) as db:
        answer = export_tables(
            db, folder, load_or_create_key(key or fleet.parent / "anonymous.key"), labels, print_progress
        )
    fleet_view.print_answer(answer, "export", as_json)


@click.command()
@FLEET
@click.option("--host", help="Address to listen on (default: web.host of FLEET).")
@click.option("--port", type=click.IntRange(0, 65535), help="TCP port, 0 for a free one (default: web.port of FLEET).")
@click.option("--json", "as_json", is_flag=True, help="Print the address as a JSON object on stdout.")
def web(fleet: Path, host: str | None, port: int | None, as_json: bool) -> None:
    """Serve the web page of all machines.

    Shows due maintenance, outliers and trends. It reads the database and connects to no machine. By default only this
    computer can connect; others need TLS and users in [web] of FLEET. Stops on SIGTERM or Ctrl-C.
    """
    from fdhil.cli.web_commands import override_address, print_address

    settings = load_fleet_config(fleet)
    with require_fleet_extra():
        from fdhil.fleet import QUERIES as _  # noqa: F401, N811 - a missing library is reported before the start
    from fdhil.web import require_extra, serve_application

    require_extra()
    from fdhil.web import make_fleet_app

    own = override_address(settings.web, host, port)
    ask = partial(query_database, settings)
    serve_application(own, lambda: make_fleet_app(own, ask), lambda url: print_address("all machines", url, as_json))


@click.command("web-user")
@FLEET
@click.argument("name")
@click.option("--remove", is_flag=True, help="Remove the user.")
@AS_JSON
def web_user(fleet: Path, name: str, remove: bool, as_json: bool) -> None:
    """Add, change or remove a user of the fleet web page.

    Prompts for the password of NAME, or reads it as the first line of standard input if that is not a terminal.
    """
    from fdhil.cli.web_commands import set_web_user

    set_web_user(load_fleet_config(fleet).web, fleet, name, "watch", remove, as_json)
