"""``fdhil advise``: the highest feed of each line at which a program keeps a tolerance."""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fdhil.api import announce_compilation
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.options import (
    AS_JSON,
    CONFIG_OPTION,
    FROM_HISTORY,
    MODEL,
    PROGRAM,
    OutputFile,
    PositiveFloat,
    WritingCommand,
)
from fdhil.cli.prediction_commands import load_inputs

if TYPE_CHECKING:
    from fdhil.config import MachineConfig
    from fdhil.prediction import FeedAdvice, FeedScaledPath
    from fdhil.records import Parameters, Trajectory

UNHELD = "{} lines leave the tolerance at every feed tried, without the correction"


@click.command(cls=WritingCommand)
@PROGRAM
@CONFIG_OPTION
@MODEL
@FROM_HISTORY
@click.option("--tolerance-um", type=PositiveFloat(), required=True, help="Largest contour error allowed, um.")
@click.option(
    "--out", type=OutputFile(), help="Write PROGRAM with the feeds that keep the tolerance without the correction."
)
@AS_JSON
@require_delivered_answer
def advise(
    program: Path,
    config_path: Path,
    model_path: Path | None,
    from_history: bool,
    tolerance_um: float,
    out: Path | None,
    as_json: bool,
) -> int:
    """Compute the highest feed that keeps a tolerance, per line of PROGRAM or per zone of a demand CSV.

    Lists only lines that leave the tolerance as programmed; consecutive lines form one range. Each range shows the
    programmed and the highest feed (mm/min), the largest error with its cause, and the highest feed with the inverse
    correction. The path is predicted with all listed feeds together. --json lists every line; --out replaces only the
    F words of the program.
    """
    if out is not None and program.suffix.lower() == ".csv":
        raise click.UsageError("--out writes F words, which a demand does not have; give the NC program")
    reference, models, config = load_inputs(program, config_path, model_path, from_history)
    from fdhil.correction import advise_with_correction, build_advice_document

    corrects = all(config.axis[axis].correction is not None for axis in reference.axes)
    announce_compilation("predict", *(["correct"] if corrects else []))
    sure, hopeful = _create_feed_sources(program, reference, models, config, tolerance_um)
    sure, hopeful = _show_trials(sure), hopeful and _show_trials(hopeful)
    advice, most = advise_with_correction(sure, hopeful, models, config, tolerance_um)
    if sys.stderr.isatty():
        click.echo(err=True)
    if not as_json:
        from fdhil.cli.advise_view import show_advice

        show_advice(advice, most, tolerance_um, corrects, lambda line: sure.feed_mm_min(line) > 0.0)
    if out is not None:
        _write_program(program, advice, config, out)
    if as_json:
        document = {"schema": "fdhil-advise-1", "program": str(program), "tolerance_um": tolerance_um}
        lines = [build_advice_document(a, most) for a in advice]
        written = None if out is None else str(out)
        click.echo(json.dumps(document | {"lines": lines, "written": written}, allow_nan=False))
    elif out is not None and (left := sum(a.plain.share is None for a in advice)):
        click.echo(UNHELD.format(left), err=True)
    return int(any(not _can_keep_tolerance(a, corrected=out is None) for a in advice))


def _can_keep_tolerance(advice: FeedAdvice, corrected: bool) -> bool:
    """Return whether some feed keeps the tolerance, without the correction or, if ``corrected``, with it."""
    ways = (advice.plain, advice.corrected) if corrected else (advice.plain,)
    return any(way is not None and way.share is not None for way in ways)


def _write_program(program: Path, advice: Sequence[FeedAdvice], config: MachineConfig, out: Path) -> None:
    from fdhil.program import Budget, replace_feeds
    from fdhil.store import open_output

    content = replace_feeds(program, {a.line: a.plain.run for a in advice}, Budget.create_from_config(config.nc))
    with open_output(out) as file:
        file.write(content)


def _create_feed_sources(
    program: Path,
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    tolerance_um: float,
) -> tuple[FeedScaledPath, FeedScaledPath | None]:
    from fdhil.correction import make_feed_sources
    from fdhil.program import Budget, interpret

    motions = (
        None if program.suffix.lower() == ".csv" else list(interpret(program, Budget.create_from_config(config.nc)))
    )
    return make_feed_sources(motions, reference, models, config, tolerance_um)


def _show_trials(source: FeedScaledPath) -> FeedScaledPath:
    if not sys.stderr.isatty():
        return source
    at, trials = source.at, itertools.count(1)

    def show_trial(shares: Mapping[int, float]) -> Trajectory:
        reference = at(shares)
        click.echo(f"\rtrial {next(trials)}, {reference.time_s[-1]:.0f} s of path ", err=True, nl=False)
        return reference

    return replace(source, at=show_trial)
