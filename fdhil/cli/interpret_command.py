"""``fdhil interpret``: list the motions of an NC program."""

import json
import shutil
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import click

from fdhil.cli.options import FILE

_SPOOL_CHARACTERS = 8_000_000


@click.command()
@click.argument("program", type=FILE)
@click.option("--config", "config_path", type=FILE, help="Machine configuration (TOML) with NC dialect and axes.")
@click.option("--json", "as_document", is_flag=True, help="Print one JSON document instead of a table.")
@click.option("--max-blocks", type=click.IntRange(min=1), default=10_000_000, show_default=True,
              help="Largest number of executed blocks.")  # fmt: skip
@click.option("--max-repeated-blocks", "max_repeated", type=click.IntRange(min=1), default=500_000, show_default=True,
              help="Largest number of blocks repeated by loops and calls.")  # fmt: skip
def interpret(program: Path, config_path: Path | None, as_document: bool, max_blocks: int, max_repeated: int) -> None:
    """List the motions of PROGRAM (ISO 6983, G-code) in machine millimetres.

    Interprets the program as LinuxCNC 2.9 does. With --config, [nc] dwell_unit and integers apply, and the program is
    refused if the machine lacks an axis or a set-point exceeds 32 bits. Nothing is printed unless the whole program can
    be interpreted.
    """
    from fdhil.config import Nc, load_config
    from fdhil.program import Budget, Interpreter, ProgramNotes, check_motions, serialise_motion

    config = None if config_path is None else load_config(config_path)
    budget = replace(
        Budget.create_from_config(Nc() if config is None else config.nc),
        max_blocks=max_blocks,
        max_repeated_blocks=max_repeated,
    )
    notes = ProgramNotes(budget.dialect)
    motions = notes.watch_motions(Interpreter(program, budget, block_delete=False).run())
    if config is not None:
        motions = check_motions(motions, config)
    with tempfile.SpooledTemporaryFile(_SPOOL_CHARACTERS, mode="w+", encoding="utf-8") as spool:
        if as_document:
            spool.write('{"schema": "fdhil-interpret-1", "motions": [')
            separator = "\n"
            for motion in motions:
                spool.write(separator + json.dumps(serialise_motion(motion)))
                separator = ",\n"
            found = [asdict(note) for note in notes.notes]
            spool.write("\n]" + (f', "notes": {json.dumps(found)}' if found else "") + "}\n")
        else:
            for row in map(serialise_motion, motions):
                values = "  ".join(f"{key} {value}" for key, value in row.items() if key not in ("line", "kind"))
                spool.write(f"{row['line']:>7}  {row['kind']:<6}  {values}\n")
        spool.seek(0)
        shutil.copyfileobj(spool, sys.stdout)
    for note in () if as_document else notes.notes:
        click.echo(f"note, {note}; {note.advice}", err=True)
