"""Shows offers to the operator: what would change, which limit is loosened, and what that makes void."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.config import MachineConfig
from fdhil.daemon.journal import printable

if TYPE_CHECKING:
    from fdhil.fleet.offered import Changed, Judged

NOTHING_ARMED = "nothing is armed by it"
RESTART = "the daemon goes on with the old configuration until it is started anew: systemctl restart fdhil"


def tell(found: Sequence[Judged], machine: MachineConfig, as_json: bool) -> None:
    """Write all offers that were found."""
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-offered-1", "offers": [_document(each, machine) for each in found]}))
        return
    for each in found:
        for line in _lines(each, machine):
            click.echo(printable(line))
    if not found:
        trusted = "" if machine.offers.trust else "; [offers] trust names no key, so that none is fetched"
        click.echo(f"no offers lie in {machine.offers_directory}{trusted}")


def accepted(done: Judged, before: MachineConfig, file: Path, as_json: bool) -> None:
    """Write what was accepted, and what is to be done next."""
    from fdhil.fleet.offered import kept_file

    assert done.offer is not None
    kept = str(kept_file(file, done.offer)) if done.changes else None
    if as_json:
        told = {"schema": "fdhil-offer-accepted-1", **_document(done, before), "kept": kept}
        click.echo(json.dumps(told))
        return
    for line in _changes(done, before):
        click.echo(printable(line))
    if kept is None:
        click.echo(f"{done.offer} is accepted; {file} said so already and is as it was")
        return
    click.echo(f"{done.offer} is accepted and in {file}; what was there before is in {kept}")
    click.echo(f"next: {RESTART}; {NOTHING_ARMED}")


def in_short(done: Judged) -> str:
    """Return the changes in one line, for the audit."""
    return "; ".join(map(_change, done.changes)) or "no value is another one"


def voids(old: MachineConfig, new: MachineConfig) -> Iterator[str]:
    """Yield what a change of the configuration makes void, in plain words."""
    from fdhil.commissioning.record import axis_digest, record_path

    for axis in new.axis:
        if record_path(new.store.directory, axis).exists() and axis_digest(old, axis) != axis_digest(new, axis):
            yield f"the commissioning record of axis {axis} holds no longer: commission it again before it is corrected"
    if old.digest != new.digest:
        yield "a correction that is on ends with the restart; none is armed until the axes are identified anew"


def _lines(each: Judged, machine: MachineConfig) -> Iterator[str]:
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
    yield from _changes(each, machine)


def _changes(each: Judged, machine: MachineConfig) -> Iterator[str]:
    for changed in each.changes:
        yield f"  {_change(changed)}"
    for changed in each.loosens:
        yield f"  LOOSENS {_change(changed)}: more is let through than before; accepted with --loosens alone"
    for doubt in each.doubts:
        yield f"  unlikely: {doubt}"
    if not each.changes:
        yield "  the configuration says so already"
    if each.config is not None:
        yield from (f"  {line}" for line in voids(machine, each.config))


def _change(changed: Changed) -> str:
    return f"{changed.path} {_value(changed.old)} -> {_value(changed.new)}"


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return "(left out)" if value is None else str(value)


def _document(each: Judged, machine: MachineConfig) -> dict[str, Any]:
    offer = each.offer
    changes = [{"key": c.path, "old": c.old, "new": c.new, "loosens": c.loosens} for c in each.changes]
    return {
        "file": str(each.place),
        "offer": None if offer is None else offer.model_dump(mode="json"),
        "wrong": each.wrong,
        "answers": [{"answer": a.answer, "by": a.by, "reason": a.reason, "at_s": a.at_s} for a in each.answers],
        "changes": changes,
        "loosens": [_change(changed) for changed in each.loosens],
        "doubts": list(each.doubts),
        "voids": list(voids(machine, each.config)) if each.config is not None else [],
    }
