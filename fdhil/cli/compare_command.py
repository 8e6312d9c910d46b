"""``fdhil compare``: compare two passes, models or recordings, before and after a change."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.options import AS_JSON, FILE
from fdhil.errors import RecordingError

if TYPE_CHECKING:
    from fdhil.records import Float

SCHEMA = "fdhil-compare-1"
REFERENCE = "_reference_mm"
ACTUAL = ("_table_mm", "_predicted_mm")  # of a trace of fdhil sim, of fdhil predict --out
Values = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Axis, parameter, then value, low and high of its 95 % interval (None if unknown)."""


@click.command()
@click.argument("before", type=FILE)
@click.argument("after", type=FILE)
@AS_JSON
def compare(before: Path, after: Path, as_json: bool) -> None:
    """Compare two passes, models or recordings, BEFORE and AFTER a change.

    A pass is a CSV with X_reference_mm and X_table_mm or X_predicted_mm, written by fdhil sim --trace or fdhil predict
    --out. Passes are compared by contour error, the distance of the table from the programmed path. Models (.json) and
    recordings are compared by their parameters.
    """
    kinds = [_determine_kind(path) for path in (before, after)]
    if kinds[0] != kinds[1]:
        raise click.UsageError(f"{before} is a {kinds[0]}, {after} a {kinds[1]}; give two files of one kind")
    document: dict[str, Any] = {"schema": SCHEMA, "kind": kinds[0]}
    if kinds[0] == "pass":
        found = {"before": read_pass(before), "after": read_pass(after)}
        old_um, new_um = (found[when]["contour"]["rms_um"] for when in ("before", "after"))
        document |= {**found, "gain": old_um / new_um if new_um > 0.0 else None}
    else:
        document |= _compare_parameters(kinds[0], before, after)
    if as_json:
        click.echo(json.dumps(document, allow_nan=False))
    else:
        _show_comparison(document)


def _determine_kind(path: Path) -> str:
    if path.suffix.lower() == ".json":
        return "model"
    if path.suffix.lower() == ".csv":
        try:
            with path.open("rb") as file:
                return "pass" if REFERENCE.encode() in file.readline(4096) else "recording"
        except OSError as error:
            raise RecordingError(f"{path} cannot be read ({error.strerror}): check the path") from None
    return "recording"


def read_pass(path: Path) -> dict[str, Any]:
    """Return contour error and axis errors of a pass, um. Raises RecordingError."""
    import numpy as np

    from fdhil.csv_text import read_csv_text
    from fdhil.prediction import compute_contour_error_um
    from fdhil.records import compute_rms, compute_table_path

    names, *rows = read_csv_text(path).splitlines()
    columns = names.split(",")
    axes = [name.removesuffix(REFERENCE) for name in columns if name.endswith(REFERENCE)]
    ends = [end for end in ACTUAL if all(f"{axis}{end}" in columns for axis in axes)]
    try:
        cells = np.array([row.split(",") for row in rows], dtype=float)
        time_s = cells[:, columns.index("time_s")]
        reference, actual = (
            cells[:, [columns.index(f"{axis}{end}") for axis in axes]] for end in (REFERENCE, *ends[:1])
        )
        fits = bool(np.isfinite(cells).all() and (np.diff(time_s) > 0.0).all() and time_s.size > 1)
    except (ValueError, IndexError):
        fits = False
    if not fits:
        wanted = f"time_s, and {' or '.join(f'{axis}{end}' for axis in axes[:1] for end in ACTUAL)} of each axis"
        raise RecordingError(f"{path} is not a pass: it needs rows of numbers with {wanted}; record it again")

    def summarise_errors(um: "Float") -> dict[str, float]:
        return {"rms_um": compute_rms(um), "max_um": float(np.max(np.abs(um)))}

    programmed, table = (compute_table_path(axes, each) for each in (reference, actual))
    return {
        "file": str(path),
        "rows": int(time_s.size),
        "contour": summarise_errors(compute_contour_error_um(programmed, table, float(np.median(np.diff(time_s))))),
        "axes": {axis: summarise_errors(1e3 * (actual - reference)[:, k]) for k, axis in enumerate(axes)},
    }


def _compare_parameters(kind: str, before: Path, after: Path) -> dict[str, Any]:
    read = _read_model_values if kind == "model" else _identify_recording
    first, second = read(before), read(after)
    if not first.keys() & second.keys():
        what = f"{before} is of axis {', '.join(first)}, {after} of {', '.join(second)}"
        raise click.UsageError(f"{what}; they have no axis in common")
    parameters = {
        axis: {
            name: {
                "before": old,
                "after": second[axis][name],
                "change_percent": _compute_change_percent(old, second[axis][name]),
            }
            for name, old in values.items()
            if name in second[axis]
        }
        for axis, values in first.items()
        if axis in second
    }
    return {"before": {"file": str(before)}, "after": {"file": str(after)}, "parameters": parameters}


def _compute_change_percent(before: Mapping[str, Any], after: Mapping[str, Any]) -> float | None:
    if before["value"] is None or after["value"] is None or before["value"] == 0.0:
        return None
    return 100.0 * float(after["value"] / before["value"] - 1.0)


def _read_model_values(path: Path) -> Values:
    from fdhil.prediction import load_model_file
    from fdhil.records import PARAMETERS

    return {
        axis: {name: {"value": getattr(model, name), "low": None, "high": None} for name in PARAMETERS}
        for axis, model in load_model_file(path).parameters.items()
    }


def _identify_recording(path: Path) -> Values:
    from fdhil.cli.batch_analysis import analyse_file
    from fdhil.config import Identification
    from fdhil.records import INTERVAL_95, PARAMETERS

    result = analyse_file(path, Identification())
    if result.axis is None or result.pooled is None or not result.verdict.accepted:
        why = "; ".join(map(str, result.verdict.reasons)) or "no rapid move was found in it"
        raise RecordingError(f"no validated parameters from {path}: {why}; see fdhil identify {path}")
    pooled = result.pooled
    values = {}
    for name in PARAMETERS:
        value, half = pooled.get_value(name), INTERVAL_95 * pooled.get_std(name)
        known = math.isfinite(value) and math.isfinite(half)
        values[name] = {
            "value": value if math.isfinite(value) else None,
            "low": value - half if known else None,
            "high": value + half if known else None,
        }
    return {result.axis: values}


def _show_comparison(document: Mapping[str, Any]) -> None:
    from rich.markup import escape

    from fdhil.cli.status_view import make_narrow_table, open_console
    from fdhil.report import compute_half_width, format_cell, format_heading

    out, files = open_console(), [Path(document[when]["file"]).name for when in ("before", "after")]
    if document["kind"] == "pass":
        table = make_narrow_table()
        table.caption = None
        for text in ("error", *files):
            table.add_column(escape(text), justify="right")
        for name in ("contour", *document["before"]["axes"]):
            sides = [document[when] for when in ("before", "after")]
            found = [side[name] if name == "contour" else side["axes"].get(name) for side in sides]
            cells = [
                "-" if each is None else f"{each['rms_um']:.2f} um RMS, max {each['max_um']:.2f}" for each in found
            ]
            table.add_row(name if name == "contour" else f"axis {name}", *cells)
        out.print(table)
        if document["gain"] is not None:
            out.print(f"contour error smaller by a factor of {document['gain']:.3g}")
        return
    for axis, parameters in document["parameters"].items():
        table = make_narrow_table(f"axis {axis}")
        for text in ("", *map(escape, files), "change"):
            table.add_column(text, justify="right")
        for name, reported in parameters.items():
            change = reported["change_percent"]
            cells = [
                format_cell(name, reported[when]["value"], compute_half_width(reported[when]), " ")
                for when in ("before", "after")
            ]
            table.add_row(
                format_heading(name).replace("\n", ", "), *cells, "-" if change is None else f"{change:+.1f} %"
            )
        out.print(table)
