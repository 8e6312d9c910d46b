"""``fdhil init``: create a machine configuration from NC files, drives and answers of the operator."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cli.options import AS_JSON, DEFAULT_CONFIG, FILE, OutputFile, WritingCommand
from fdhil.errors import ConfigError, ConfigFault, OutputError

if TYPE_CHECKING:
    from fdhil.commissioning import ConfigDraft, FoundBus, LinuxcncMachine, Look, OperatorQuestion, SourcedValue

SCHEMA = "fdhil-init-1"
INTERFACES = Path("/sys/class/net")
CAN_TYPE = "280"  # ARPHRD_CAN of the kernel
NEXT = (
    ("doctor", "diagnose this PC, bus and drives"),
    ("check", "compare the drives with the file"),
    ("commission", "prepare for a correction; nothing is sent before"),
    ("run", "identify and predict"),
)


@click.command(cls=WritingCommand)
@click.argument("file", type=OutputFile(".toml"), default=DEFAULT_CONFIG)
@click.option("--answers", type=FILE,
              help="Answers (TOML) with the keys of the configuration; disables all prompts.")  # fmt: skip
@click.option("--from-linuxcnc", "ini", type=FILE, metavar="INI",
              help="Read axes, speeds and scales from this LinuxCNC machine and its HAL files.")  # fmt: skip
@click.option("--hal", is_flag=True,
              help="Use LinuxCNC's HAL pins as drives, and write a HAL file next to FILE.")  # fmt: skip
@click.option("--eds", "places", multiple=True, type=FILE,
              help="EDS or DCF file, or folder of such files (default: the folder of FILE).")  # fmt: skip
@click.option("--offline", is_flag=True, help="Do not access a bus or a running HAL; prompt for their values instead.")
@click.option("--dry-run", is_flag=True, help="Print the file instead of writing it.")
@AS_JSON
def init(
    file: Path,
    answers: Path | None,
    ini: Path | None,
    hal: bool,
    places: tuple[Path, ...],
    offline: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Create the configuration FILE of a machine from NC files, drives and questions.

    Reads LinuxCNC's files, listens to the CAN bus and, if no NC runs it, reads scales and ratings from the drives.
    Prompts for the remaining values, with proposals. Nothing is written to a drive, nothing moves, and an existing
    FILE is never overwritten. FILE names the source of each value.
    """
    if offline and places:
        raise click.UsageError("--eds needs drives on the bus, which --offline does not access; give only one of them")
    if hal and ini is None:
        raise click.UsageError("--hal reads the pins from LinuxCNC's files; give --from-linuxcnc INI as well")
    if hal and places:
        raise click.UsageError("--eds needs drives on a CAN bus, which --hal does not use; give only one of them")
    hal_file = file.with_suffix(".hal")
    for each in (file, hal_file) if hal else (file,):
        if each.exists() and not dry_run:
            text = "exists, and fdhil init never overwrites a file; name another file, or move it away"
            raise OutputError(f"{each} {text}")
    given = machine_config.read_toml(answers, "a file of answers") if answers is not None else {}
    from fdhil.commissioning import finish_draft, make_draft, read_linuxcnc

    nc = read_linuxcnc(ini) if ini is not None else None
    ask = _ask_operator if answers is None and not as_json else None
    if nc is not None and hal:
        draft = make_draft(file, given, nc, ask, pins=[] if offline else read_running_pins())
    else:
        draft = make_draft(
            file, given, nc, ask, None if offline else _make_bus_scanner(places, file.parent), _find_can_interface()
        )
    text = finish_draft(draft, file)
    made = {file: text} | ({hal_file: _build_hal_file(text, file, nc, draft)} if nc is not None and hal else {})
    for place, content in made.items() if not dry_run else ():
        with place.open("x", encoding="utf-8") as out:  # never overwrites a file created meanwhile
            out.write(content)
    if as_json:
        click.echo(json.dumps(_build_init_document(draft, file, text, dry_run)))
    elif dry_run:
        click.echo(text, nl=False)
    _print_summary(draft, file, dry_run, as_json)


def read_running_pins() -> list[str]:
    """Return the pins of the running HAL; empty if it does not run or is not accessible."""
    try:
        listing = subprocess.run(
            ["halcmd", "-s", "show", "pin"], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return []
    return [words[4] for line in listing.stdout.splitlines() if len(words := line.split()) > 4]


def _build_hal_file(text: str, file: Path, nc: LinuxcncMachine, draft: ConfigDraft) -> str:
    from fdhil.commissioning import find_insertions, format_correction_hal

    machine = machine_config.parse_config(machine_config.parse_toml(text.encode(), str(file)), str(file), file.parent)
    corrected = [axis for axis, settings in machine.axis.items() if settings.correction is not None]
    draft.notes.append(
        f"{file.with_suffix('.hal').name} loads the bridge: add it as the last HALFILE in [HAL] of the INI; "
        f"LinuxCNC's user must be able to read {file.name}"
    )
    splices = find_insertions(nc.hal, nc.joints, corrected)
    return format_correction_hal(machine, str(file.resolve()), nc.joint_count, splices, nc.hal)


def _make_bus_scanner(places: Sequence[Path], folder: Path) -> Look:
    from fdhil.commissioning import find_drives, read_descriptions

    descriptions, faults = read_descriptions(places or [folder])
    if faults and places:
        raise faults[0]

    def scan_bus(name: str, settings: machine_config.CanBus) -> FoundBus:
        click.echo(f"listening on bus {name}, then reading from the drives; nothing is written to them", err=True)
        found = find_drives(name, settings, descriptions)
        for drive in found.drives:
            click.echo(f"  {drive.name}: profile {drive.profile or 'unknown'}", err=True)
        return found

    return scan_bus


def _find_can_interface() -> SourcedValue | None:
    from fdhil.commissioning import SourcedValue

    found = [place.parent.name for place in sorted(INTERFACES.glob("*/type")) if place.read_text().strip() == CAN_TYPE]
    source = "this PC's CAN interface" if len(found) == 1 else f"guessed: the first of {', '.join(found)}"
    return SourcedValue(found[0], source, len(found) > 1) if found else None


def _ask_operator(asked: OperatorQuestion) -> Any:
    """Prompt until the answer is a valid value; return None if the proposal is accepted."""
    click.echo(f"\n{asked.path}: {asked.meaning}" if asked.meaning else f"\n{asked.path}", err=True)
    click.echo(f"  where: {asked.where}", err=True)
    if asked.proposal is not None:
        click.echo(f"  proposed: {asked.proposal.value} ({asked.proposal.source})", err=True)
    while True:
        default = None if asked.proposal is None else str(asked.proposal.value)
        try:
            answer = str(click.prompt("  value", default=default, show_default=default is not None, err=True)).strip()
        except click.Abort as stopped:
            if sys.stdin.isatty() or not isinstance(stopped.__context__, EOFError):
                raise
            fault = ConfigFault(asked.path, "needs an answer, and standard input has ended", "give --answers FILE")
            raise ConfigError("standard input", [fault]) from None
        if answer == default:
            return None
        try:
            return asked.check(answer)
        except ConfigError as error:
            click.echo(f"  {error.faults[0].what}; try again", err=True)


def _build_init_document(draft: ConfigDraft, file: Path, text: str, dry_run: bool) -> dict[str, Any]:
    values = [
        {"path": path, "value": setting.value, "source": setting.source, "guessed": setting.guessed}
        for path, setting in draft.values.items()
    ]
    return {
        "schema": SCHEMA,
        "file": str(file),
        "written": not dry_run,
        "values": values,
        "notes": draft.notes,
        "text": text,
    }


def _list_guesses(draft: ConfigDraft) -> list[str]:
    # equal guesses of several axes become one line
    places: dict[tuple[str, str, str], list[str]] = {}
    for path, setting in draft.values.items():
        if setting.guessed:
            where, axis, key = path.split(".", 2) if path.startswith("axis.") else ("", "", path)
            places.setdefault((key, str(setting.value), setting.source), []).append(f"{where}.{axis}" if axis else "")
    return [
        f"{key}{' of ' if axes[0] else ''}{', '.join(axes)} = {value}: {source}"
        for (key, value, source), axes in places.items()
    ]


def _print_summary(draft: ConfigDraft, file: Path, dry_run: bool, quiet: bool) -> None:
    # with --dry-run stdout has the file
    if quiet:
        return

    def print_line(line: str) -> None:
        click.echo(line, err=dry_run)

    done = "would be written" if dry_run else "written"
    print_line(f"{file} {done}: {len(draft.values)} values, {draft.guessed_count} of them guessed")
    for line in _list_guesses(draft):
        print_line(f"  check {line}")
    for note in draft.notes:
        print_line(f"note: {note}")
    for command, why in NEXT:
        print_line(f"next: fdhil {command} {file}  ({why})")
    sys.stdout.flush()
