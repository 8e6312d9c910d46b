"""Shows proposed changes to the operator: values, loosened limits, and what becomes invalid."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.config import MachineConfig
from fdhil.daemon import escape_unprintable

if TYPE_CHECKING:
    from fdhil.fleet import ReviewedOffer, ValueChange

NOTHING_ARMED = "nothing is armed"
RESTART = "restart the daemon, which still uses the old configuration: systemctl restart fdhil"


def print_offers(found: Sequence[ReviewedOffer], machine: MachineConfig, as_json: bool) -> None:
    """Print all proposed changes."""
    if as_json:
        click.echo(
            json.dumps(
                {"schema": "fdhil-offered-1", "offers": [_build_offer_document(each, machine) for each in found]}
            )
        )
        return
    for each in found:
        for line in _describe_offer(each, machine):
            click.echo(escape_unprintable(line))
    if not found:
        trusted = "" if machine.offers.trust else "; none is fetched, because [offers] trust names no key"
        click.echo(f"no proposed changes in {machine.offers_directory}{trusted}")


def print_acceptance(done: ReviewedOffer, before: MachineConfig, file: Path, as_json: bool) -> None:
    """Print the accepted changes and the next action."""
    from fdhil.fleet import build_backup_path

    assert done.offer is not None
    kept = str(build_backup_path(file, done.offer)) if done.changes else None
    if as_json:
        click.echo(
            json.dumps({"schema": "fdhil-offer-accepted-1", **_build_offer_document(done, before), "kept": kept})
        )
        return
    for line in _describe_changes(done, before):
        click.echo(escape_unprintable(line))
    if kept is None:
        click.echo(f"{done.offer} accepted; {file} has these values already and was not changed")
        return
    click.echo(f"{done.offer} accepted and written to {file}; the previous file is {kept}")
    click.echo(f"next: {RESTART}; {NOTHING_ARMED}")


def summarise_changes(done: ReviewedOffer) -> str:
    """Return the changes in one line, for the audit log."""
    return "; ".join(map(_format_change, done.changes)) or "no value changes"


def describe_voided_items(old: MachineConfig, new: MachineConfig) -> Iterator[str]:
    """Yield what a change of the configuration invalidates, as text."""
    from fdhil.commissioning import build_record_path, compute_axis_digest

    for axis in new.axis:
        if build_record_path(new.store.directory, axis).exists() and compute_axis_digest(
            old, axis
        ) != compute_axis_digest(new, axis):
            yield f"the commissioning record of axis {axis} becomes invalid: commission it before the next correction"
    if old.digest != new.digest:
        yield "the restart ends an active correction; arming is refused until the axes are identified again"


def _describe_offer(each: ReviewedOffer, machine: MachineConfig) -> Iterator[str]:
    if each.offer is None:
        yield f"{each.place}: {each.wrong}"
        return
    offer = each.offer
    yield f"{offer}, stage {offer.stage}, by {offer.by}: {offer.text}"
    for answer in each.answers:
        yield f"  {answer.answer} by {answer.by}{': ' if answer.reason else ''}{answer.reason}"
    if each.wrong:
        yield f"  cannot be accepted: {each.wrong}"
        return
    yield from _describe_changes(each, machine)


def _describe_changes(each: ReviewedOffer, machine: MachineConfig) -> Iterator[str]:
    for changed in each.changes:
        yield f"  {_format_change(changed)}"
    for changed in each.loosened_values:
        yield f"  LOOSENS {_format_change(changed)}: more is permitted than before; accepting needs --loosens"
    for doubt in each.doubts:
        yield f"  implausible: {doubt}"
    if not each.changes:
        yield "  the configuration has these values already"
    if each.config is not None:
        yield from (f"  {line}" for line in describe_voided_items(machine, each.config))


def _format_change(changed: ValueChange) -> str:
    return f"{changed.path} {_format_value(changed.old)} -> {_format_value(changed.new)}"


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return "(not set)" if value is None else str(value)


def _build_offer_document(each: ReviewedOffer, machine: MachineConfig) -> dict[str, Any]:
    offer = each.offer
    changes = [{"key": c.path, "old": c.old, "new": c.new, "loosens": c.loosens} for c in each.changes]
    return {
        "file": str(each.place),
        "offer": None if offer is None else offer.model_dump(mode="json"),
        "wrong": each.wrong,
        "answers": [{"answer": a.answer, "by": a.by, "reason": a.reason, "at_s": a.at_s} for a in each.answers],
        "changes": changes,
        "loosens": [_format_change(changed) for changed in each.loosened_values],
        "doubts": list(each.doubts),
        "voids": list(describe_voided_items(machine, each.config)) if each.config is not None else [],
    }
