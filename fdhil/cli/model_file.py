"""Writes what recordings tell as a model file, which ``--model`` of predict and correct reads."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from fdhil.cli.batch import FileResult
from fdhil.config import Axis
from fdhil.identification.loops import better_loops, changed_regulators, regulators_of, with_loops
from fdhil.records import PARAMETERS, Estimate, LoopEstimate
from fdhil.store.output import open_output


def write_model(results: Sequence[FileResult], axes: Mapping[str, Axis], path: Path) -> None:
    """Write the validated pools by axis, of several files of one axis the last one's.

    What has to be given is the ``axes``' nominal value; click.UsageError where a value stays unknown. Without a
    validated pool nothing is written, which is reported on stderr.
    """
    valid = {r.axis: (r.pooled, r.loops) for r in results if r.axis and r.pooled is not None and r.verdict.accepted}
    if not valid:
        click.echo(f"fdhil: {path} is not written: no recording gives a validated model", err=True)
        return
    document = {
        name: {**_model(name, estimate, axes.get(name)), **_loops(loops, axes.get(name))}
        for name, (estimate, loops) in valid.items()
    }
    unchecked = [name for name, (_, loops) in valid.items() if loops is None and name not in axes]
    if unchecked:
        text = f"fdhil: {path} has no loops of axis {', '.join(unchecked)}: predict and correct will use the configured"
        click.echo(f"{text} regulators, which these recordings did not confirm; give --config or --loops", err=True)
    with open_output(path) as file:
        file.write((json.dumps(document, indent=2, allow_nan=False) + "\n").encode())


def _model(name: str, estimate: Estimate, axis: Axis | None) -> dict[str, Any]:
    values = {key: estimate.value(key) for key in PARAMETERS}
    unknown = [key for key, value in values.items() if not math.isfinite(value)]
    if unknown and axis is None:
        text = f"{' and '.join(unknown)} of axis {name} cannot be told without a voltage"
        raise click.UsageError(f"{text}: give its nominal values with --config to have a whole model written")
    if axis is not None:
        values |= {key: float(getattr(axis.nominal, key)) for key in unknown}
    terms = {key: estimate.value(key) for key in estimate.terms}
    return {**values, "terms": terms} if terms else values


def _loops(found: LoopEstimate | None, axis: Axis | None) -> dict[str, Any]:
    """Return the table of the loops by which the model was validated, empty where those are the configured ones."""
    if found is None or not found.verdict.accepted:
        return {}
    if axis is None:
        return {"loops": regulators_of(found)}
    changed = changed_regulators(axis, with_loops(axis, found)) if better_loops(found) else {}
    return {"loops": changed} if changed else {}
