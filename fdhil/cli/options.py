"""Types of option values that several commands share."""

import math
import os
from pathlib import Path
from typing import Any

import click

from fdhil.store.output import check_output

# whether it can be read is seen where it is read: a file that cannot is trouble, not a wrong call
FILE = click.Path(path_type=Path, readable=False)
FOLDER = click.Path(path_type=Path, readable=False, file_okay=False)
CONFIG = click.argument("config", type=FILE)
FLEET = click.argument("fleet", type=FILE)
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout.")
LINES = click.option("--json", "as_json", is_flag=True, help="Write each log line as a JSON object to stdout.")
COLUMNS = click.option(
    "--columns",
    type=FILE,
    help="Column map (TOML): which column of another program's file is which signal, in which unit.",
)


class Positive(click.FloatRange):
    """A finite number above 0, or of a range above it: nan, which no range refuses, and infinity are wrong too."""

    def __init__(self, least: float | None = None, most: float | None = None) -> None:
        super().__init__(min=least or 0.0, max=most, min_open=least is None)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; click.BadParameter where it is none."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number


class OutputFile(click.Path):
    """A file to be written, looked at before the work is done; with ``suffixes`` its name must end in one of them."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(path_type=Path, readable=False)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path; OutputError where nothing can be written there, BadParameter for an unknown suffix."""
        path = Path(value)
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            self.fail(f"{value}: the name must end in {', '.join(self._suffixes)}.", param, ctx)
        check_output(path)
        return path


class Picture(OutputFile):
    """A picture to be written, ``-`` where its name follows from what is drawn."""

    def __init__(self) -> None:
        super().__init__(".png", ".svg", ".pdf")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path. Errors as of an :class:`OutputFile`."""
        return Path(value) if str(value) == "-" else super().convert(value, param, ctx)


class Writing(click.Command):
    """A command that writes files: never over one that it reads, and each file once."""

    def invoke(self, ctx: click.Context) -> Any:
        """Compare what is written with what is read, then run."""
        given = [(p, path) for p in self.params for path in _paths(ctx.params.get(str(p.name)))]
        for k, (option, path) in enumerate(given):
            for other, there in given[:k] + given[k + 1 :]:
                if isinstance(option.type, OutputFile) and _same_file(path, there):
                    text = f"{path} is also what {other.human_readable_name} names; choose another name"
                    raise click.BadParameter(text, ctx, option)
        return super().invoke(ctx)


def _same_file(path: Path, there: Path) -> bool:
    """Whether two names are of one regular file, one that is there or one that is to be."""
    try:
        return path.samefile(there) and path.is_file()
    except OSError:  # one is not there, or nobody may look
        return os.path.realpath(path) == os.path.realpath(there)


def _paths(value: Any) -> list[Path]:
    values = value if isinstance(value, tuple) else (value,)
    return [path for path in values if isinstance(path, Path)]
