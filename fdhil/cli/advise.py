"""``fdhil advise``: where a program leaves a tolerance, why, and how fast it may run there."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fdhil.api.compiling import forewarn
from fdhil.cli.failing import verdict
from fdhil.cli.options import AS_JSON, CONFIG_OPTION, FILE, OutputFile, Positive, Writing
from fdhil.cli.prediction import inputs

if TYPE_CHECKING:
    from fdhil.config import MachineConfig
    from fdhil.prediction.advise import Advice
    from fdhil.prediction.feed_search import Source
    from fdhil.records import Parameters, Trajectory

UNHELD = "{} lines leave the tolerance at every feed that was tried, without the correction"


@click.command(cls=Writing)
@click.argument("program", type=FILE, metavar="PROGRAM|DEMAND.csv")
@CONFIG_OPTION
@click.option("--model", "model_path", type=FILE, help="Parameters of each axis (JSON).")
@click.option("--from-history", is_flag=True, help="Use the newest validated parameters of the store.")
@click.option(
    "--tolerance-um",
    type=Positive(),
    required=True,
    help="Largest contour error allowed.",
)
@click.option("--out", type=OutputFile(), help="Write PROGRAM with these feeds, those without the correction.")
@AS_JSON
@verdict
def advise(
    program: Path,
    config_path: Path,
    model_path: Path | None,
    from_history: bool,
    tolerance_um: float,
    out: Path | None,
    as_json: bool,
) -> int:
    """Compute the highest feed that keeps a tolerance, for each line of PROGRAM or each zone of a demand CSV.

    Only what leaves the tolerance as programmed is listed, lines that follow each other in one range: F as programmed
    and as it may be (mm/min), the worst place and why, and the highest feed there with the inverse correction. All
    these feeds together were predicted to keep the tolerance. --json lists every line; --out writes the program with
    its F words replaced and everything else kept.

    Exit codes: 0 every line can be held by some feed (with --out: also without the correction), 1 some line cannot, 2
    wrong option, model or configuration, 3 a file cannot be read or written.
    """
    if out is not None and program.suffix.lower() == ".csv":
        raise click.UsageError("--out writes an NC program, and a demand has no F words; give the program")
    reference, models, config = inputs(program, config_path, model_path, from_history)
    from fdhil.correction.result_documents import advised, entry

    corrects = all(config.axis[axis].correction is not None for axis in reference.axes)
    forewarn("predict", *(["correct"] if corrects else []))
    sure, hopeful = _sources(program, reference, models, config, tolerance_um)
    sure, hopeful = _telling(sure), hopeful and _telling(hopeful)
    advice, most = advised(sure, hopeful, models, config, tolerance_um)
    if sys.stderr.isatty():
        click.echo(err=True)
    if not as_json:
        from fdhil.cli.advise_view import show

        show(advice, most, tolerance_um, corrects, lambda line: sure.feed_mm_min(line) > 0.0)
    if out is not None:
        _write(program, advice, config, out)
    if as_json:
        document = {"schema": "fdhil-advise-1", "program": str(program), "tolerance_um": tolerance_um}
        lines = [entry(a, most) for a in advice]
        written = None if out is None else str(out)
        click.echo(json.dumps(document | {"lines": lines, "written": written}, allow_nan=False))
    elif out is not None and (left := sum(a.plain.share is None for a in advice)):
        click.echo(UNHELD.format(left), err=True)
    return int(any(not _held(a, corrected=out is None) for a in advice))


def _held(advice: Advice, corrected: bool) -> bool:
    """Whether some feed holds a stretch, without the correction or, where that counts too, with it."""
    ways = (advice.plain, advice.corrected) if corrected else (advice.plain,)
    return any(way is not None and way.share is not None for way in ways)


def _write(program: Path, advice: Sequence[Advice], config: MachineConfig, out: Path) -> None:
    from fdhil.program import Budget
    from fdhil.program.feed_words import with_feeds
    from fdhil.store.output import open_output

    content = with_feeds(program, {a.line: a.plain.run for a in advice}, Budget.of(config.nc))
    with open_output(out) as file:
        file.write(content)


def _sources(
    program: Path,
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
) -> tuple[Source, Source | None]:
    from fdhil.correction.result_documents import sources
    from fdhil.program import Budget, interpret

    motions = None if program.suffix.lower() == ".csv" else list(interpret(program, Budget.of(config.nc)))
    return sources(motions, reference, models, config, tolerance_um)


def _telling(source: Source) -> Source:
    """Return the source that shows on a terminal how often the path was run, and how long it is by now."""
    if not sys.stderr.isatty():
        return source
    at, trials = source.at, itertools.count(1)

    def told(shares: Mapping[int, float]) -> Trajectory:
        reference = at(shares)
        click.echo(f"\rtrial {next(trials)}, {reference.time_s[-1]:.0f} s of path ", err=True, nl=False)
        return reference

    return replace(source, at=told)
