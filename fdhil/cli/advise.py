"""``fdhil advise``: where a program leaves a tolerance, why, and how fast it may run there."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.prediction import FILE, inputs

if TYPE_CHECKING:
    from fdhil.config import MachineConfig
    from fdhil.prediction.advise import Advice, Source
    from fdhil.records import Float, Parameters, Trajectory


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

    Only lines that leave the tolerance as programmed are listed: where and why, and the highest feed without and with
    the inverse correction. A demand CSV has no lines: it is played slower, and its zones are listed.

    Exit codes: 0 every line can be held by some feed, 1 some line cannot, 2 wrong option, model or configuration, 3 a
    file cannot be read.
    """
    reference, models, config = inputs(program, config_path, model_path, from_history)
    from fdhil.prediction import advise as advising

    corrects = all(config.axis[axis].correction is not None for axis in reference.axes)
    advice = advising.advise(
        _source(program, reference, config),
        models,
        config,
        tolerance_um,
        (lambda slower: _corrected(slower, models, config)) if corrects else None,
    )
    if as_json:
        document = {"schema": "fdhil-advise-1", "program": str(program), "tolerance_um": tolerance_um}
        click.echo(json.dumps(document | {"lines": [_entry(a) for a in advice]}, allow_nan=False))
    else:
        _show(advice, tolerance_um, corrects)
    return 1 if any(a.share is None and a.corrected_share is None for a in advice) else 0


def _source(program: Path, reference: Trajectory, config: MachineConfig) -> Source:
    from fdhil.prediction import advise as advising
    from fdhil.program import Budget, interpret

    if program.suffix.lower() == ".csv":
        return advising.demand_source(reference)
    return advising.program_source(list(interpret(program, Budget.of(config.nc))), config)


def _corrected(reference: Trajectory, models: dict[str, Parameters], config: MachineConfig) -> Float:
    """Contour error (n,) with the correction; that without it where it is refused."""
    from fdhil import correction

    return correction.plan(reference, models, config).after.contour_um


def _entry(advice: Advice) -> dict[str, Any]:
    demand = advice.demand
    return {
        "line": advice.line,
        "where": advice.where,
        "cause": advice.cause,
        "error_um": advice.error_um,
        "beyond": None if demand is None else dict(zip(("axis", "what", "share"), demand, strict=True)),
        "feed_mm_min": advice.feed_mm_min,
        "feed_share": advice.share,
        "advised_feed_mm_min": _feed(advice, advice.share),
        "corrected_feed_share": advice.corrected_share,
        "corrected_feed_mm_min": _feed(advice, advice.corrected_share),
    }


def _feed(advice: Advice, share: float | None) -> float | None:
    return None if share is None else share * advice.feed_mm_min


def _show(advice: Sequence[Advice], tolerance_um: float, corrects: bool) -> None:
    if not advice:
        click.echo(f"the whole path stays within {tolerance_um:g} um as programmed")
    for a in advice:
        name = f"line {a.line}" if a.line else "the demand"
        click.echo(f"{name}: {a.error_um:.1f} um at {a.where} ({a.cause}) at {a.feed_mm_min:.0f} mm/min")
        if a.demand:
            axis, what, share = a.demand
            click.echo(f"  the drive of axis {axis} is asked for {share * 100:.0f} % of its {what} limit")
        click.echo(f"  {_told(_feed(a, a.share), 'without correction')}")
        if corrects:
            click.echo(f"  {_told(_feed(a, a.corrected_share), 'with the correction')}")
    if advice and not corrects:
        click.echo("the correction was not tried: an axis has no section [axis.X.correction]")


def _told(feed_mm_min: float | None, how: str) -> str:
    return f"{how}: " + (f"at most {feed_mm_min:.0f} mm/min" if feed_mm_min else "no feed that was tried holds it")
