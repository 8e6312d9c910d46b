"""``fdhil fleet``: services, retention, anonymous export and the web page of the fleet."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fdhil.cli.fleet import with_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET, help_epilog
from fdhil.cli.terminal_text import print_progress
from fdhil.config.fleet import load


@click.command(
    epilog=help_epilog(
        "fdhil fleet service fleet.toml --machine mill-7 --axis X --note 'new ball screw'",
        trouble="the database cannot be reached",
    )
)
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
    from fdhil.cli import fleet_view

    if remove and at is None:
        raise click.UsageError("--remove needs the recorded --date")
    when = datetime.now(UTC).replace(microsecond=0) if at is None else at.replace(tzinfo=UTC)
    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import services, sets
    with sets.entered(settings) as db:
        if remove:
            answer = services.remove(db, machine, axis or "", when)
        else:
            answer = services.enter(db, machine, axis or "", when, note)
    fleet_view.tell(answer, "service", as_json, fleet_view.service)


@click.command(epilog=help_epilog("fdhil fleet services fleet.toml", trouble="the database cannot be reached"))
@FLEET
@click.option("--machine", help="Restrict to one machine.")
@AS_JSON
def services(fleet: Path, machine: str | None, as_json: bool) -> None:
    """List the services and the parameters that each changed.

    Newest first, with the change from the sets before to those after and its 95 % interval.
    """
    from fdhil.cli import fleet_view
    from fdhil.cli.fleet import _answer

    answer = _answer(fleet, "services", machine=machine)
    fleet_view.tell(answer, "services", as_json, fleet_view.services)


@click.command(epilog=help_epilog("fdhil fleet retain fleet.toml", trouble="the database cannot be reached"))
@FLEET
@AS_JSON
def retain(fleet: Path, as_json: bool) -> None:
    """Delete the records and windows older than [retention] of FLEET allows.

    Deletes whole months of records, and files of windows. Run it once a day by a timer. The first parameters of each
    axis are kept, and deleted records do not count as missing.
    """
    from fdhil.cli import fleet_view

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import retention, sets
    with sets.entered(settings) as db:
        answer = retention.retain(db, settings, datetime.now(UTC), print_progress)
    fleet_view.tell(answer, "retain", as_json, fleet_view.retain)


@click.command(
    epilog=help_epilog(
        "fdhil fleet export fleet.toml --anonymous shared/", "exported", trouble="the database cannot be reached"
    )
)
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
    from fdhil.cli import fleet_view

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import export as given_away
        from fdhil.fleet import sets
    with sets.asking(settings) as db:
        answer = given_away.export(
            db, folder, given_away.key_of(key or fleet.parent / "anonymous.key"), labels, print_progress
        )
    fleet_view.tell(answer, "export", as_json, fleet_view.export)


@click.command(
    epilog=help_epilog("fdhil fleet web fleet.toml --port 8080", "stopped", trouble="address or database unavailable")
)
@FLEET
@click.option("--host", help="Address to listen on (default: web.host of FLEET).")
@click.option("--port", type=click.IntRange(0, 65535), help="TCP port, 0 for a free one (default: web.port of FLEET).")
@click.option("--json", "as_json", is_flag=True, help="Print the address as a JSON object on stdout.")
def web(fleet: Path, host: str | None, port: int | None, as_json: bool) -> None:
    """Serve the web page of all machines.

    Shows due maintenance, outliers and trends. It reads the database and connects to no machine. By default only this
    computer can connect; others need TLS and users in [web] of FLEET. Stops on SIGTERM or Ctrl-C.
    """
    from fdhil.cli.web import placed, tell_ready

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import questions, sets
    from fdhil.web import serving

    serving.require()
    from fdhil.web.fleet_app import make_fleet_app

    def ask(question: str, **given: str | None) -> Any:
        with sets.asking(settings) as db:
            return getattr(questions, question)(db, **given)

    own = placed(settings.web, host, port)
    serving.serve(own, lambda: make_fleet_app(own, ask), lambda url: tell_ready("all machines", url, as_json))


@click.command("web-user", epilog=help_epilog("fdhil fleet web-user fleet.toml anna"))
@FLEET
@click.argument("name")
@click.option("--remove", is_flag=True, help="Remove the user.")
@AS_JSON
def web_user(fleet: Path, name: str, remove: bool, as_json: bool) -> None:
    """Add, change or remove a user of the fleet web page.

    Prompts for the password of NAME, or reads it as the first line of standard input if that is not a terminal.
    """
    from fdhil.cli.web import set_user

    set_user(load(fleet).web, fleet, name, "watch", remove, as_json)
