"""``fdhil fleet key | sign | stage``: the works' side of the roll-out of configurations."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.failing import verdict
from fdhil.cli.fleet import with_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET, OutputFile, Writing

if TYPE_CHECKING:
    from fdhil.fleet.offer import Change, Offer
    from fdhil.fleet.rollout import Standing, Told

CHANGE = click.argument("change", type=FILE)
MACHINES = click.option("--machine", "machines", multiple=True, help="A machine, by its name in the works; repeatable.")


@click.command()
@click.argument("file", type=FILE)
@AS_JSON
def key(file: Path, as_json: bool) -> None:
    """Make the key FILE to sign offers with.

    It has mode 0600; of one that is there the public key is told. That goes into [offers] trust of each machine, by its
    operator. Who has FILE can sign in your name.
    """
    with with_extra():
        from fdhil.fleet.offer import make_key, public_key
    made = not file.exists()
    told = make_key(file) if made else public_key(file)
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-fleet-key-1", "file": str(file), "made": made, "public_key": told}))
        return
    click.echo(
        f"{file} {'is made' if made else 'is there already'}; its public key, for [offers] trust of each machine:"
    )
    click.echo(told)


@click.command(cls=Writing)
@CHANGE
@click.option("--key", "key_file", type=FILE, required=True, help="The file of the key to sign with.")
@click.option("--by", required=True, help="Who signs: your name, which the operators read.")
@MACHINES
@click.option("--out", type=OutputFile(".offer"), required=True, help="The file to write, to be carried to machines.")
@AS_JSON
def sign(change: Path, key_file: Path, by: str, machines: tuple[str, ...], out: Path, as_json: bool) -> None:
    """Write the offer of CHANGE as a signed file.

    It is carried by hand, and no server is needed. Without --machine it is for all machines that have the labels of
    CHANGE.
    """
    with with_extra():
        from fdhil.fleet.offer import sign as signed
        from fdhil.fleet.rollout import offer_of, read_change
    from fdhil.store.output import open_output

    told, days = read_change(change)
    offer = offer_of(told, days, by, 1, machines)
    document = signed(offer, key_file)
    with open_output(out) as file:
        file.write(document)
    if as_json:
        told_json = {"schema": "fdhil-fleet-sign-1", "file": str(out), "offer": offer.model_dump(mode="json")}
        click.echo(json.dumps(told_json))
        return
    click.echo(f"{offer} is signed; at the machine: fdhil offers list machine.toml {out}")


@click.command()
@FLEET
@CHANGE
@click.option("--key", "key_file", type=FILE, help="The file of the key to sign with; without it nothing is opened.")
@click.option("--by", default="", help="Who signs: your name, which the operators read.")
@click.option("--count", type=click.IntRange(min=1), help="How many machines the stage has; left out: all the rest.")
@MACHINES
@click.option("--despite", default="", help="Why it goes on although not all machines before stand well.")
@click.option("--withdraw", is_flag=True, help="Take CHANGE back from the machines that have not accepted it.")
@AS_JSON
@verdict
def stage(
    fleet: Path,
    change: Path,
    key_file: Path | None,
    by: str,
    count: int | None,
    machines: tuple[str, ...],
    despite: str,
    withdraw: bool,
    as_json: bool,
) -> int:
    """Show how far CHANGE is rolled out, or go on with it.

    What the machines told of it; with --key it is offered to the next of them. A further stage is opened when all
    machines before have accepted CHANGE, have identified with it, and have told no notice since. Exit 1 when that is
    not so.
    """
    from fdhil.config.fleet import load

    settings = load(fleet)
    with with_extra():
        from fdhil.fleet import rollout
    told, days = rollout.read_change(change)
    if key_file is not None and not by:
        raise click.UsageError("--key signs a stage, which needs --by: who signs")
    if key_file is not None and withdraw:
        raise click.UsageError("--withdraw takes back what --key would offer: give one of them")

    async def work() -> tuple[Standing, Offer | None, list[str]]:
        async with rollout.entered(settings) as db:
            found = await rollout.standing(db, told)
            if key_file is None:
                return found, None, await rollout.take_back(settings, found, told.name) if withdraw else []
            names = rollout.chosen(found, count, machines, despite)
            offer = rollout.offer_of(told, days, by, found.stage + 1, names)
            await rollout.open_stage(settings, db, offer, told, key_file, despite)
            return found, offer, []

    found, opened, withdrawn = asyncio.run(work())
    _tell(told, found, opened, withdrawn, as_json)
    return 1 if any(each.against for each in found.offered) and opened is None and not withdraw else 0


def _tell(change: Change, found: Standing, opened: Offer | None, withdrawn: Sequence[str], as_json: bool) -> None:
    from fdhil.daemon.journal import printable

    if as_json:
        click.echo(json.dumps({**_document(change, found, opened), "withdrawn": list(withdrawn)}))
        return
    for line in _lines(change, found, opened):
        click.echo(printable(line))
    if withdrawn:
        click.echo(printable(f"it is taken back from {_named(withdrawn)}; who has accepted it keeps it"))


def _lines(change: Change, found: Standing, opened: Offer | None) -> Iterator[str]:
    for each in found.offered:
        told = each.against or "accepted, and stands well"
        yield f"stage {each.stage}  {each.machine}: {told}"
    if opened is not None:
        names = _named(opened.machines)
        yield f"{opened}, stage {opened.stage}, is offered to {names}; their operators accept or reject it"
    else:
        yield f"{change.name} version {change.version}: {len(found.left)} machines are left{_behind(found.left)}"


def _behind(left: Sequence[str]) -> str:
    return f" ({_named(left)})" if left else ""


def _named(machines: Sequence[str]) -> str:
    more = f" and {len(machines) - 10} more" if len(machines) > 10 else ""
    return f"{', '.join(machines[:10])}{more}"


def _document(change: Change, found: Standing, opened: Offer | None) -> dict[str, Any]:
    def of(each: Told) -> dict[str, Any]:
        return {
            "machine": each.machine, "stage": each.stage, "answer": each.answer or None, "by": each.answered_by,
            "reason": each.reason, "in_use": each.in_use, "notices": each.notices, "against": each.against,
        }  # fmt: skip

    return {
        "schema": "fdhil-fleet-stage-1",
        "name": change.name,
        "version": change.version,
        "offered": list(map(of, found.offered)),
        "left": list(found.left),
        "opened": None if opened is None else {"stage": opened.stage, "machines": list(opened.machines)},
    }
