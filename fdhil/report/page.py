"""One self-contained HTML page: no script, no font, no picture from elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from fdhil.errors import FdhilError
from fdhil.store.output import open_output


@dataclass(frozen=True, slots=True)
class Table:
    """A table: ``head`` names the columns, each row has as many cells."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Section:
    """A titled part of the page: text, tables, then figures as (caption, inline SVG), one a row when ``wide``."""

    title: str
    text: str = ""
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, str]] = ()
    wide: bool = False


@dataclass(frozen=True, slots=True)
class Page:
    """A report: its headline figures as (label, value), then its sections."""

    title: str
    subtitle: str
    headline: Sequence[tuple[str, str]] = ()
    sections: Sequence[Section] = field(default_factory=tuple)


def _is_word(table: Table, column: int) -> bool:
    """Whether a column holds words, which begin at one edge, not numbers, which end at one."""
    return any(row[column][:1].isalpha() for row in table.rows)


def require() -> None:
    """Raise FdhilError where what draws and renders a report is not installed."""
    if any(find_spec(name) is None for name in ("jinja2", "matplotlib")):
        raise FdhilError("a report needs the extra 'report': pip install 'fdhil[report]'")


def write(page: Page, path: Path) -> None:
    """Render ``page`` to ``path``, whole or not at all. OutputError when it cannot be written."""
    require()
    from jinja2 import Environment

    template = files("fdhil.report").joinpath("page.html.j2").read_text("utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    text = environment.from_string(template).render(page=page, is_word=_is_word)
    with open_output(path) as file:
        file.write(text.encode())
