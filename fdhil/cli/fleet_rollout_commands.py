"""``fdhil fleet key | sign | stage``: sign configuration changes and roll them out in stages."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.fleet_commands import require_fleet_extra
from fdhil.cli.options import AS_JSON, FILE, FLEET, OutputFile, WritingCommand

if TYPE_CHECKING:
    from fdhil.fleet import MachineResponse, Offer, ProposedChange, RolloutStatus

CHANGE = click.argument("change", type=FILE)
MACHINES = click.option("--machine", "machines", multiple=True, help="Fleet name of a machine; repeatable.")


@click.command()
@click.argument("file", type=FILE)
@AS_JSON
def key(file: Path, as_json: bool) -> None:
    """Create the key FILE for signing configuration changes.

    FILE gets mode 0600 and is never overwritten. Prints the public key, which the operator of each machine adds to
    [offers] trust. Anybody with access to FILE can sign in your name.
    """
    with require_fleet_extra():
        from fdhil.fleet import create_key, read_public_key
    made = not file.exists()
    public = create_key(file) if made else read_public_key(file)
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-fleet-key-1", "file": str(file), "made": made, "public_key": public}))
        return
    click.echo(f"{file} {'created' if made else 'exists already'}; its public key, for [offers] trust of each machine:")
    click.echo(public)


@click.command(cls=WritingCommand)
@CHANGE
@click.option("--key", "key_file", type=FILE, required=True, help="Key file to sign with.")
@click.option("--by", required=True, help="Name of the signer, shown to the operators.")
@MACHINES
@click.option("--out", type=OutputFile(".offer"), required=True, help="File to write, for transfer to the machines.")
@AS_JSON
def sign(change: Path, key_file: Path, by: str, machines: tuple[str, ...], out: Path, as_json: bool) -> None:
    """Write CHANGE as a signed change file.

    The file is carried to the machines by hand; no server is needed. Without --machine it applies to all machines with
    the labels of CHANGE.
    """
    with require_fleet_extra():
        from fdhil.fleet import create_offer, read_change
        from fdhil.fleet import sign_offer as signed
    from fdhil.store import open_output

    proposal, days = read_change(change)
    offer = create_offer(proposal, days, by, 1, machines)
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
@click.option("--key", "key_file", type=FILE, help="Key file to sign with; without it no stage is opened.")
@click.option("--by", default="", help="Name of the signer, shown to the operators.")
@click.option("--count", type=click.IntRange(min=1), help="Number of machines in the stage (default: all remaining).")
@MACHINES
@click.option("--despite", default="", help="Reason for opening a stage although earlier machines are not ready.")
@click.option("--withdraw", is_flag=True, help="Withdraw CHANGE from machines that have not accepted it.")
@AS_JSON
@require_delivered_answer
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
    """Show the roll-out of CHANGE, or open its next stage.

    Lists the answers of the machines. With --key CHANGE is proposed to the next machines, once all earlier ones have
    accepted it, have identified with it, and have reported no notice since.
    """
    from fdhil.config import load_fleet_config

    settings = load_fleet_config(fleet)
    with require_fleet_extra():
        from fdhil.fleet import (
            choose_machines,
            connect_database,
            create_offer,
            open_stage,
            read_change,
            read_rollout_status,
            withdraw_change,
        )
    proposal, days = read_change(change)
    if key_file is not None and not by:
        raise click.UsageError("--key signs a stage; name the signer with --by")
    if key_file is not None and withdraw:
        raise click.UsageError("--withdraw and --key exclude each other; give only one of them")

    async def advance_rollout() -> tuple[RolloutStatus, Offer | None, list[str]]:
        async with connect_database(settings) as db:
            found = await read_rollout_status(db, proposal)
            if key_file is None:
                return found, None, await withdraw_change(settings, found, proposal.name) if withdraw else []
            names = choose_machines(found, count, machines, despite)
            offer = create_offer(proposal, days, by, found.stage + 1, names)
            await open_stage(settings, db, offer, proposal, key_file, despite)
            return found, offer, []

    found, opened, withdrawn = asyncio.run(advance_rollout())
    _print_stage(proposal, found, opened, withdrawn, as_json)
    return 1 if any(each.objection for each in found.offered) and opened is None and not withdraw else 0


def _print_stage(
    change: ProposedChange, found: RolloutStatus, opened: Offer | None, withdrawn: Sequence[str], as_json: bool
) -> None:
    from fdhil.daemon import escape_unprintable

    if as_json:
        click.echo(json.dumps({**_build_stage_document(change, found, opened), "withdrawn": list(withdrawn)}))
        return
    for line in _describe_stage(change, found, opened):
        click.echo(escape_unprintable(line))
    if withdrawn:
        click.echo(
            escape_unprintable(f"withdrawn from {_format_machines(withdrawn)}; machines that accepted it keep it")
        )


def _describe_stage(change: ProposedChange, found: RolloutStatus, opened: Offer | None) -> Iterator[str]:
    for each in found.offered:
        yield f"stage {each.stage}  {each.machine}: {each.objection or 'accepted and validated'}"
    if opened is not None:
        names = _format_machines(opened.machines)
        yield f"{opened}, stage {opened.stage}, is proposed to {names}; their operators accept or reject it"
    else:
        names = f" ({_format_machines(found.remaining)})" if found.remaining else ""
        yield f"{change.name} version {change.version}: {len(found.remaining)} machines remain{names}"


def _format_machines(machines: Sequence[str]) -> str:
    more = f" and {len(machines) - 10} more" if len(machines) > 10 else ""
    return f"{', '.join(machines[:10])}{more}"


def _build_stage_document(change: ProposedChange, found: RolloutStatus, opened: Offer | None) -> dict[str, Any]:
    def describe_machine(each: MachineResponse) -> dict[str, Any]:
        return {
            "machine": each.machine, "stage": each.stage, "answer": each.answer or None, "by": each.answered_by,
            "reason": each.reason, "in_use": each.in_use, "notices": each.notices, "against": each.objection,
        }  # fmt: skip

    return {
        "schema": "fdhil-fleet-stage-1",
        "name": change.name,
        "version": change.version,
        "offered": list(map(describe_machine, found.offered)),
        "left": list(found.remaining),
        "opened": None if opened is None else {"stage": opened.stage, "machines": list(opened.machines)},
    }
