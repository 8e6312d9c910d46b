"""``fdhil audit``: show the audit log and verify its integrity."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from fdhil import config as machine_config
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import AS_JSON, CONFIG


@click.command()
@CONFIG
@click.option(
    "--last", type=click.IntRange(min=1), default=20, show_default=True, help="Number of newest entries to show."
)
@AS_JSON
@require_delivered_answer
def audit(config: Path, last: int, as_json: bool) -> int:
    """Show the audit log of CONFIG's machine and verify that it was not modified.

    The log lists each request to the machine with its time, client and result.
    """
    machine = machine_config.load_config(config)
    from fdhil.daemon import escape_unprintable
    from fdhil.store import AUDIT_FILE_NAME, read_entries

    found = list(read_entries(machine.store.directory))
    broken = [number for number, (_, wrong) in enumerate(found, start=1) if wrong]
    path = machine.store.directory / AUDIT_FILE_NAME
    if as_json:
        shown = [{"number": number, **entry} for number, (entry, _) in enumerate(found, start=1)][-last:]
        document = {"schema": "fdhil-audit-1", "file": str(path), "entries": shown, "of": len(found), "broken": broken}
        click.echo(json.dumps(document))
        return 1 if broken else 0
    for number, (entry, wrong) in list(enumerate(found, start=1))[-last:]:
        click.echo(escape_unprintable(_format_entry(number, entry, wrong)))
    click.echo(_summarise_integrity(path, len(found), broken))
    return 1 if broken else 0


def _format_entry(number: int, entry: Mapping[str, Any], wrong: str | None) -> str:
    if wrong is not None or not isinstance(entry.get("who"), dict):
        return f"{number:6d}  NOT INTACT  {json.dumps(entry)}"
    who = entry["who"]
    by = f" for {entry['by']}" if entry.get("by") else ""
    what = entry.get("asked") or entry.get("answered")
    outcome = ", ".join(map(str, filter(None, (entry.get("result"), entry.get("text")))))
    result = f": {outcome}" if outcome else " (requested)"
    program = "".join(f" {entry[key]}" for key in ("axis", "program", "offer") if entry.get(key))
    return f"{number:6d}  {entry.get('time')}  {who.get('user')}{by}  {what}{program}{result}"


def _summarise_integrity(path: Path, count: int, broken: list[int]) -> str:
    if not count:
        return f"{path}: no requests yet"
    if not broken:
        return f"{path}: {count} entries, all intact"
    causes = "changed, removed, moved, or cut off by a power failure; compare with the daemon's journal"
    return f"{path}: {len(broken)} of {count} entries are not intact, the first is number {broken[0]}: {causes}"
