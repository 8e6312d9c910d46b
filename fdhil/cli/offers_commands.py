"""``fdhil offers``: proposed configuration changes of this machine, and the operator's answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fdhil import config as machine_config
from fdhil.cli.audit_hook import audit_action
from fdhil.cli.cli_errors import SuggestingGroup, require_delivered_answer
from fdhil.cli.fleet_commands import require_fleet_extra
from fdhil.cli.options import AS_JSON, CONFIG, FILE, ConfigFirstCommand
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError, ConfigFault

if TYPE_CHECKING:
    pass

OFFER = click.argument("offer", type=FILE)
BY = click.option("--by", required=True, help="Your name, reported to the fleet server.")
MOST_BY, MOST_REASON = 64, 200


@click.group(cls=SuggestingGroup)
def offers() -> None:
    """List, accept or reject proposed configuration changes.

    A proposed change (OFFER) is signed, arrives through fdhil uplink or as a file, and has no effect until it is
    accepted. Needs the extra 'fleet'.
    """


@offers.command("list", cls=ConfigFirstCommand)
@CONFIG
@click.argument("files", nargs=-1, type=FILE)
@AS_JSON
@require_delivered_answer
def list_(config: Path, files: tuple[Path, ...], as_json: bool) -> int:
    """List the proposed changes of CONFIG's machine.

    Includes those in FILES. Shows the new values and what they invalidate. Nothing is changed.
    """
    machine_config.load_config(config)
    with require_fleet_extra():
        from fdhil.fleet import load_current_machine, review_offer
    from fdhil.cli import offers_view
    from fdhil.store import list_offers

    machine = load_current_machine(config)
    found = [review_offer(place, machine) for place in (*list_offers(machine.config.offers_directory), *files)]
    offers_view.print_offers(found, machine.config, as_json)
    return 1 if any(each.wrong for each in found if each.place in files) else 0


@offers.command(cls=ConfigFirstCommand)
@CONFIG
@OFFER
@BY
@click.option("--loosens", "may_loosen", is_flag=True, help="Permit the change to loosen limits.")
@AS_JSON
@require_delivered_answer
def accept(config: Path, offer: Path, by: str, may_loosen: bool, as_json: bool) -> None:
    """Accept OFFER and write its changes to CONFIG.

    OFFER is a name from fdhil offers list, or a file. Signature, validity, version and the new configuration are
    verified again. The old CONFIG is kept next to it. A running daemon uses the new values after a restart; nothing is
    armed.
    """
    machine = machine_config.load_config(config)
    by, place = _validate_text("--by", by, MOST_BY), _find_offer_file(machine, offer)
    with require_fleet_extra():
        from fdhil.fleet import accept_offer as write
    from fdhil.cli import offers_view

    with audit_action(machine, "accept an offer", offer=str(offer), by=by) as ended:
        done = write(place, config, by, may_loosen)
        ended["text"] = offers_view.summarise_changes(done)
    offers_view.print_acceptance(done, machine, config, as_json)


@offers.command(cls=ConfigFirstCommand)
@CONFIG
@OFFER
@BY
@click.option("--reason", required=True, help="Reason, reported to the fleet server.")
@AS_JSON
def reject(config: Path, offer: Path, by: str, reason: str, as_json: bool) -> None:
    """Reject OFFER, with a reason.

    The fleet server is informed. The configuration does not change.
    """
    machine = machine_config.load_config(config)
    by, place, reason = (
        _validate_text("--by", by, MOST_BY),
        _find_offer_file(machine, offer),
        _validate_text("--reason", reason, MOST_REASON),
    )
    with require_fleet_extra():
        from fdhil.fleet import reject_offer as note
    with audit_action(machine, "reject an offer", offer=str(offer), by=by) as ended:
        done = note(place, config, by, reason)
        ended["text"] = reason
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-offer-rejected-1", "offer": str(done.offer)}))
    else:
        click.echo(f"{done.offer} rejected; nothing was changed")


def _validate_text(option: str, text: str, most: int) -> str:
    from fdhil.daemon import escape_unprintable

    if not text.strip() or len(text) > most:
        raise ConfigError(option, [ConfigFault(option, "is empty or too long", f"at most {most} characters")])
    return escape_unprintable(text.strip())


def _find_offer_file(machine: MachineConfig, offer: Path) -> Path:
    from fdhil.store import list_offers

    if offer.suffix == ".offer" or offer.name != str(offer):
        return offer
    lie = list_offers(machine.offers_directory)
    of_name = {version: path for path, (name, version) in lie.items() if name == str(offer)}
    if not of_name:
        names = ", ".join(sorted({name for name, _ in lie.values()})) or "none"
        fault = ConfigFault(
            str(offer), "is not a proposed change of this machine", f"choose one of: {names}; or name a file, *.offer"
        )
        raise ConfigError("OFFER", [fault])
    return of_name[max(of_name)]
