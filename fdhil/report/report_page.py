"""Renders one self-contained HTML page: pictures and scripts are embedded, nothing is loaded from elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from importlib.resources import files
from importlib.util import find_spec
from itertools import groupby
from operator import itemgetter
from pathlib import Path

from fdhil.errors import FdhilError
from fdhil.report.typography import typeset_markup, typeset_text
from fdhil.store import open_output


@dataclass(frozen=True, slots=True)
class Table:
    """A table: ``head`` names the columns; ``folded`` is the summary line of a collapsed one."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    folded: str = ""


@dataclass(frozen=True, slots=True)
class Section:
    """A titled part of the page: text, tables, then figures as (caption, inline SVG), one a row when ``wide``.

    Sections of one ``chapter`` appear together under its title.
    """

    title: str
    text: str = ""
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, str]] = ()
    wide: bool = False
    chapter: str = ""


@dataclass(frozen=True, slots=True)
class Page:
    """A report: its headline figures as (label, value), then its sections."""

    title: str
    subtitle: str
    headline: Sequence[tuple[str, str]] = ()
    sections: Sequence[Section] = field(default_factory=tuple)


def _is_text_column(table: Table, column: int) -> bool:
    return any(row[column][:1].isalpha() for row in table.rows)


def require_libraries() -> None:
    """Raise FdhilError where the libraries for reports are not installed."""
    if any(find_spec(name) is None for name in ("jinja2", "matplotlib")):
        raise FdhilError("a report needs two libraries (the extra 'report'): pip install jinja2 matplotlib")


def write_page(page: Page, path: Path) -> None:
    """Render ``page`` to ``path`` atomically. OutputError when it cannot be written."""
    text = render_html(page)
    with open_output(path) as file:
        file.write(text.encode())


def render_html(page: Page, now: datetime | None = None) -> str:
    """Return the page as one HTML document. FdhilError without the extra ``report``."""
    require_libraries()
    from jinja2 import Environment

    made_by = f"fdhil {version('fdhil')}"
    written = (now or datetime.now(UTC)).strftime("%Y-%m-%d %H:%M UTC")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters.update(
        typeset=typeset_text, picture=_prepare_picture, anchor=lambda title: title.lower().replace(" ", "-")
    )
    numbered = enumerate((section.chapter, section.title) for section in page.sections)
    chapters = groupby(((chapter, (k + 1, title)) for k, (chapter, title) in numbered), key=itemgetter(0))
    return environment.from_string(_read_asset("page.html.j2")).render(
        page=page,
        chapters=[(chapter, [title for _, title in titles]) for chapter, titles in chapters],
        is_word=_is_text_column,
        made_by=made_by,
        stamp=f"Written {written} by {made_by}",
        live=any("<metadata>" in svg for section in page.sections for _, svg in section.figures),
        uplot_css=_read_asset("uplot/uPlot.min.css"),
        uplot_js=_read_asset("uplot/uPlot.iife.min.js"),
        page_js=_read_asset("page.js"),
    )


def _read_asset(name: str) -> str:
    return files("fdhil.report").joinpath(name).read_text("utf-8")


def _prepare_picture(svg: str, caption: str) -> str:
    if "aria-label=" not in svg[:1000]:
        svg = svg.replace("<svg", f'<svg role="img" aria-label="{escape(caption)}"', 1)
    return typeset_markup(svg)
