"""The courses of the parameters as a picture (extra ``report``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fdhil.errors import FdhilError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def courses(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Return a figure with one panel per parameter, one line per axis with its 95 % interval, over the revisions.

    FdhilError when matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise FdhilError("a plot needs the extra 'report': pip install 'fdhil[report]'") from None
    figure = Figure(figsize=(10, 6), layout="constrained")
    names = list(rows[0]["parameters"]) if rows else []
    for k, name in enumerate(names):
        panel = figure.add_subplot(2, 3, k + 1)
        for axis in dict.fromkeys(row["axis"] for row in rows):
            told = [(row["revision"], row["parameters"][name]) for row in rows if row["axis"] == axis]
            revisions = [revision for revision, _ in told]
            panel.plot(revisions, [p["value"] for _, p in told], marker=".", label=axis)
            known = [(r, p["low"], p["high"]) for r, p in told if p["low"] is not None]
            if known:
                at, low, high = zip(*known, strict=True)
                panel.fill_between(at, low, high, alpha=0.2)
        panel.set_title(f"{name} [{rows[0]['parameters'][name]['unit']}]")
        panel.set_xlabel("revision")
        panel.legend()
    return figure


def write_plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the courses as a PNG. FdhilError when there is nothing to plot or the file cannot be written."""
    if not rows:
        raise FdhilError("there is nothing to plot: no parameters were published yet; let the daemon see some rapids")
    figure = courses(rows)
    try:
        figure.savefig(path, format="png", dpi=120)
    except OSError as error:
        raise FdhilError(f"the plot {path} cannot be written: {error.strerror}; choose another name") from None
