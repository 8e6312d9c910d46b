"""``fdhil advise``: how fast a program may run to stay within a tolerance without any correction."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fdhil.cli.prediction import FILE, inputs


@click.command()
@click.argument("program", type=FILE, metavar="PROGRAM|DEMAND.csv")
@click.option("--config", "config_path", type=FILE, required=True, help="The machine's configuration (TOML).")
@click.option("--model", "model_path", type=FILE, help="Parameters of each axis (JSON).")
@click.option("--from-history", is_flag=True, help="Use the newest validated parameters of the store.")
@click.option(
    "--tolerance-um",
    type=click.FloatRange(min=0.0, min_open=True),
    required=True,
    help="Largest contour error allowed.",
)
@click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout and nothing else.")
def advise(
    program: Path,
    config_path: Path,
    model_path: Path | None,
    from_history: bool,
    tolerance_um: float,
    as_json: bool,
) -> int:
    """Tell for each line of a PROGRAM (NC program or demand CSV) the highest feed within a tolerance.

    Only lines that leave the tolerance as programmed are listed. Exit codes: 0 every line can be held by some feed, 1
    some line cannot, 2 wrong option, model or configuration, 3 a file cannot be read.
    """
    reference, models, config = inputs(program, config_path, model_path, from_history)
    from fdhil.prediction import advise as advising
    from fdhil.program import Budget, interpret

    if program.suffix.lower() == ".csv":
        at = advising.demand_at(reference)
    else:
        at = advising.program_at(list(interpret(program, Budget.of(config.nc))), config)
    advice = advising.advise(at, models, config, tolerance_um)
    if as_json:
        lines = [{"line": a.line, "error_um": a.error_um, "where": a.where, "feed_share": a.share} for a in advice]
        document = {"schema": "fdhil-advise-1", "program": str(program), "tolerance_um": tolerance_um, "lines": lines}
        click.echo(json.dumps(document, allow_nan=False))
    else:
        if not advice:
            click.echo(f"the whole path stays within {tolerance_um:g} um as programmed")
        for a in advice:
            name = f"line {a.line}" if a.line else "the demand"
            told = f"at most {a.share * 100:.0f} % of the feed" if a.share else "no feed that was tried holds it"
            click.echo(f"{name}: {a.error_um:.1f} um at {a.where}; {told}")
    return 1 if any(a.share is None for a in advice) else 0
