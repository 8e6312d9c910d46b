"""Types of option values that several commands share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from fdhil.store.output import check_output


class Positive(click.FloatRange):
    """A finite number above 0: nan, which no range refuses, and infinity are wrong too."""

    def __init__(self) -> None:
        super().__init__(min=0.0, min_open=True)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; click.BadParameter where it is none."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


class OutputFile(click.Path):
    """A file to be written, looked at before the work is done; with ``suffixes`` its name must end in one of them."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(path_type=Path)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path; OutputError where nothing can be written there, BadParameter for an unknown suffix."""
        path = Path(value)
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            self.fail(f"{value}: the name must end in {', '.join(self._suffixes)}.", param, ctx)
        check_output(path)
        return path
