"""``fdhil interpret``: the motions of an NC program."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

import click

from fdhil.cli.options import FILE

_SPOOL_CHARACTERS = 8_000_000


@click.command()
@click.argument("program", type=FILE)
@click.option("--json", "as_document", is_flag=True, help="Print one JSON document instead of a table.")
@click.option("--max-blocks", type=click.IntRange(min=1), default=10_000_000, show_default=True,
              help="Blocks that may be executed before the program is refused.")  # fmt: skip
@click.option("--max-repeated-blocks", "max_repeated", type=click.IntRange(min=1), default=500_000, show_default=True,
              help="Of these, blocks that loops and calls may execute again.")  # fmt: skip
def interpret(program: Path, as_document: bool, max_blocks: int, max_repeated: int) -> None:
    """List the motions that PROGRAM (ISO 6983, G-code) orders, in machine millimetres.

    Nothing is printed unless the whole program can be interpreted.
    """
    from fdhil.program.budget import Budget
    from fdhil.program.interpreter import Interpreter
    from fdhil.program.motions import as_json

    motions = Interpreter(program, Budget(max_blocks, max_repeated), block_delete=False).run()
    with tempfile.SpooledTemporaryFile(_SPOOL_CHARACTERS, mode="w+", encoding="utf-8") as spool:
        if as_document:
            spool.write('{"schema": "fdhil-interpret-1", "motions": [')
            separator = "\n"
            for motion in motions:
                spool.write(separator + json.dumps(as_json(motion)))
                separator = ",\n"
            spool.write("\n]}\n")
        else:
            spool.writelines(_row(as_json(motion)) for motion in motions)
        spool.seek(0)
        shutil.copyfileobj(spool, sys.stdout)


def _row(motion: dict[str, object]) -> str:
    """One line of the table: line, kind, then what the motion has."""
    values = "  ".join(f"{key} {value}" for key, value in motion.items() if key not in ("line", "kind"))
    return f"{motion['line']:>7}  {motion['kind']:<6}  {values}\n"
