"""``fdhil fleet``: what a works does with its history: services, what is let go of, what is given away, the page."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fdhil.cli.fleet import with_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET
from fdhil.cli.terminal_text import print_progress
from fdhil.config.fleet import load


@click.command()
@FLEET
@click.option("--machine", required=True, help="The machine, by its name in the works.")
@click.option("--axis", help="Its axis; left out: the whole machine.")
@click.option("--date", "at", type=click.DateTime(["%Y-%m-%d", "%Y-%m-%dT%H:%M"]), help="When (UTC); left out: now.")
@click.option("--note", default="", help="What was done.")
@click.option("--remove", is_flag=True, help="Take out what was entered for that --date.")
@AS_JSON
def service(
    fleet: Path, machine: str, axis: str | None, at: datetime | None, note: str, remove: bool, as_json: bool
) -> None:
    """Record a service of an axis.

    Its age and its limits count from there; fdhil fleet services tells what each service changed.
    """
    from fdhil.cli import fleet_view

    if remove and at is None:
        raise click.UsageError("--remove needs the --date that was entered")
    when = datetime.now(UTC).replace(microsecond=0) if at is None else at.replace(tzinfo=UTC)
    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import services, sets
    with sets.entered(settings) as db:
        if remove:
            told = services.remove(db, machine, axis or "", when)
        else:
            told = services.enter(db, machine, axis or "", when, note)
    fleet_view.tell(told, "service", as_json, fleet_view.service)


@click.command()
@FLEET
@click.option("--machine", help="One machine only.")
@AS_JSON
def services(fleet: Path, machine: str | None, as_json: bool) -> None:
    """Show all services and what each changed.

    The newest first; the sets before and after it, with the 95 % interval.
    """
    from fdhil.cli import fleet_view
    from fdhil.cli.fleet import _answer

    told = _answer(fleet, "services", machine=machine)
    fleet_view.tell(told, "services", as_json, fleet_view.services)


@click.command()
@FLEET
@AS_JSON
def retain(fleet: Path, as_json: bool) -> None:
    """Delete records that [retention] of FLEET does not keep.

    Whole months of records, and the files of windows. Started once a day, by a timer. The first parameters of each axis
    stay, and nothing that goes is called missing.
    """
    from fdhil.cli import fleet_view

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import retention, sets
    with sets.entered(settings) as db:
        told = retention.retain(db, settings, datetime.now(UTC), print_progress)
    fleet_view.tell(told, "retain", as_json, fleet_view.retain)


@click.command()
@FLEET
@click.option(
    "--anonymous", "folder", type=FILE, required=True, help="The new folder to write, without any name in it."
)
@click.option("--label", "labels", multiple=True, help="A label of machines or axes that may be told; repeatable.")
@click.option("--key", type=FILE, help="The key of the names; left out: anonymous.key beside FLEET, made at first.")
@AS_JSON
def export(fleet: Path, folder: Path, labels: tuple[str, ...], key: Path | None, as_json: bool) -> None:
    """Export the machines' records without names.

    Parquet files: machines have a keyed digest for a name, times are ages in months, texts and labels are left out but
    for those that are asked for. Who keeps the key can find a machine again; never give it away.
    """
    from fdhil.cli import fleet_view

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import export as given_away
        from fdhil.fleet import sets
    with sets.asking(settings) as db:
        told = given_away.export(
            db, folder, given_away.key_of(key or fleet.parent / "anonymous.key"), labels, print_progress
        )
    fleet_view.tell(told, "export", as_json, fleet_view.export)


@click.command()
@FLEET
@click.option("--host", help="Address to listen at; left out: web.host of FLEET, else 127.0.0.1.")
@click.option("--port", type=click.IntRange(0, 65535), help="TCP port; 0 takes a free one. Left out: web.port.")
@click.option("--json", "as_json", is_flag=True, help="Tell the address as a JSON object on stdout.")
def web(fleet: Path, host: str | None, port: int | None, as_json: bool) -> None:
    """Serve the page of all machines.

    What is due, who is unlike its sisters, how each axis moved. It reads the database and reaches no machine. It
    listens on this computer alone; beyond it only with TLS and users ([web] of FLEET, as of a machine). Stops on
    SIGTERM or Ctrl-C.
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
            return questions.QUERIES[question](db, **given)

    own = placed(settings.web, host, port)
    serving.serve(own, lambda: make_fleet_app(own, ask), lambda url: tell_ready("all machines", url, as_json))


@click.command("web-user")
@FLEET
@click.argument("name")
@click.option("--remove", is_flag=True, help="Take the user out.")
@AS_JSON
def web_user(fleet: Path, name: str, remove: bool, as_json: bool) -> None:
    """Manage the users of the page of all machines.

    Gives the user NAME a password, or takes the user out. The password is asked for, or is the first line of standard
    input where that is no terminal.
    """
    from fdhil.cli.web import set_user

    set_user(load(fleet).web, fleet, name, "watch", remove, as_json)
