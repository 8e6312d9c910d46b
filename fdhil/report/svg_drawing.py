"""Draws with matplotlib into inline SVG with alternative text and data for the page's script."""

from __future__ import annotations

import io
import json
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, REFERENCE = "#1d2733", "#9aa5b1"
# the colours of the web pages too (``app.css``, ``program.css``): hues of Okabe and Ito, which stay apart in print and
# for colour-blind readers, dark enough to be read as text on white; and the shades of an error, from little to much
COLOURS = ("#0072b2", "#b84f00", "#007a59", "#a3437c", "#8a5c00", "#5b5f97")
SHADES = ("#a9bccb", "#7fa8c4", "#4f93b5", "#4379a8", "#6b5ba5", "#94407f", "#b3261e", "#6d0b12")
LEFT, RIGHT, BELOW, ABOVE = 0.8, 0.2, 0.55, 0.35  # margins, inches
LETTERS_PER_INCH = 15.5  # of a legend
HANDLE_LETTERS = 8  # width of a legend's line next to its name
LEGEND_LINE = 0.2  # inches


@dataclass(slots=True)
class Drawing:
    """A figure in progress: set ``alt`` and ``data`` inside the context, then ``svg`` holds the result."""

    figure: Figure
    axes: Axes
    alt: str = ""
    data: Mapping[str, Any] | None = None
    svg: str = ""


@contextmanager
def open_drawing(width: float = 6.4, height: float = 3.6, above: float = ABOVE) -> Iterator[Drawing]:
    """Open a figure with one pair of axes and a margin ``above``, all in inches."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(Path(__file__).with_name("fdhil.mplstyle")):
        figure = Figure(figsize=(width, height))
        # fixed margins: matplotlib's own layout would draw every figure twice
        box = (LEFT / width, BELOW / height, 1 - (LEFT + RIGHT) / width, 1 - (BELOW + above) / height)
        made = Drawing(figure, figure.add_axes(box))
        yield made
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    made.svg = _make_inline(text.getvalue(), made.alt, made.data)


def _make_inline(text: str, alt: str, data: Mapping[str, Any] | None) -> str:
    """Return SVG that may share a page with others: unique identifiers, alternative text, data."""
    body = text[text.index("<svg") :]
    mark = f"f{zlib.crc32(body.encode()):08x}"
    body = re.sub(r'id="', f'id="{mark}-', body)
    body = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{mark}-", body)
    metadata = (
        "" if data is None else f"<metadata>{escape(json.dumps(data, separators=(',', ':')), quote=False)}</metadata>"
    )
    words = f' role="img" aria-label="{escape(alt)}"' if alt else ""
    start, _, rest = body.partition(">")
    return f"{start}{words}>{metadata}{rest}"


def compute_legend_layout(labels: list[str], width: float) -> tuple[int, int]:
    """Return columns and rows of a legend that is at most ``width`` inches wide."""
    letters = HANDLE_LETTERS + max(map(len, labels), default=0)
    columns = max(1, min(len(labels), int(width * LETTERS_PER_INCH / letters)))
    return columns, -(-len(labels) // columns)


def place_legend_above(axes: Axes, columns: int, handles: list[Any] | None = None) -> None:
    """Put the legend above the picture; a click on a name hides its curve."""
    found = axes.get_legend_handles_labels()[0] if handles is None else handles
    legend = axes.legend(
        handles=found, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderpad=0.1, borderaxespad=0.3
    )
    for k, (handle, text) in enumerate(zip(found, legend.get_texts(), strict=True)):
        if hasattr(handle, "set_gid"):
            handle.set_gid(f"trace-{k}")
        text.set_gid(f"legend-{k}")
