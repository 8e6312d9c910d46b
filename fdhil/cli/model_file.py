"""Writes identified models to a file for ``--model`` of ``fdhil predict`` and ``correct``."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from fdhil.api import FileResult
from fdhil.config import Axis
from fdhil.identification import apply_loops, find_changed_regulators, get_regulator_values, is_better_than_configured
from fdhil.records import PARAMETERS, Estimate, LoopEstimate, Reason
from fdhil.store import open_output
from fdhil.validation import LOOPS_DIFFER


def write_model(results: Sequence[FileResult], axes: Mapping[str, Axis], path: Path) -> None:
    """Write the validated pooled parameters of each axis; of several files of one axis, the last.

    Undetermined parameters get the nominal values of ``axes``; raises click.UsageError if one stays unknown. Nothing is
    written, with a message on stderr, without validated parameters, or if rapids of any file refute the loops that the
    model would use.
    """
    valid = {r.axis: r.pooled for r in results if r.axis and r.pooled is not None and r.verdict.accepted}
    if not valid:
        click.echo(f"fdhil: {path} is not written, because no recording gives a validated model", err=True)
        return
    loops = {
        r.axis: found for r in results if r.axis and (found := _select_loops(r.loops, axes.get(r.axis))) is not None
    }
    refuting = {r.axis: reason for r in results if r.axis and (reason := _find_refuting_reason(r, axes)) is not None}
    if wrong := sorted(refuting.keys() & valid.keys() - loops.keys()):
        text = f"axis {wrong[0]}: {refuting[wrong[0]]}; {refuting[wrong[0]].advice}"
        click.echo(f"fdhil: {path} is not written, its loops would be wrong: {text}", err=True)
        return
    if unchecked := sorted(valid.keys() - loops.keys() - axes.keys()):
        text = f"fdhil: {path} has no loops of axis {', '.join(unchecked)}: predict and correct will use the configured"
        click.echo(f"{text} regulators, which these recordings did not confirm; give --config or --loops", err=True)
    shown = {r.axis: {"held_out": asdict(r.held_out)} for r in results if r.axis and r.held_out is not None}
    document = {
        name: _build_model(name, pooled, axes.get(name)) | loops.get(name, {}) | shown.get(name, {})
        for name, pooled in valid.items()
    }
    with open_output(path) as file:
        file.write((json.dumps(document, indent=2, allow_nan=False) + "\n").encode())


def _build_model(name: str, estimate: Estimate, axis: Axis | None) -> dict[str, Any]:
    values = {key: estimate.get_value(key) for key in PARAMETERS}
    unknown = [key for key, value in values.items() if not math.isfinite(value)]
    if unknown and axis is None:
        text = f"{' and '.join(unknown)} of axis {name} cannot be determined without a voltage"
        raise click.UsageError(f"{text}; give --config with nominal values to write a complete model")
    if axis is not None:
        values |= {key: float(getattr(axis.nominal, key)) for key in unknown}
    terms = {key: estimate.get_value(key) for key in estimate.terms}
    return {**values, "terms": terms} if terms else values


def _find_refuting_reason(result: FileResult, axes: Mapping[str, Axis]) -> Reason | None:
    """Return the reason why the loops used with a model cannot be the drive's, or None."""
    reasons = [reason for reason in result.verdict.reasons if reason.code == LOOPS_DIFFER]
    if result.loops is not None and result.axis not in axes:
        reasons += result.loops.verdict.reasons
    return reasons[0] if reasons else None


def _select_loops(found: LoopEstimate | None, axis: Axis | None) -> dict[str, Any] | None:
    """Return the loops that explain the rapids better than the configured ones, or None."""
    if found is None or not found.verdict.accepted:
        return None
    if axis is None or found.configured_um is None:
        return {"loops": get_regulator_values(found)}
    return (
        {"loops": find_changed_regulators(axis, apply_loops(axis, found))} if is_better_than_configured(found) else None
    )
