"""Option types and help texts that several commands share."""

import math
import os
import stat
import sys
from pathlib import Path
from typing import Any

import click

from fdhil.cli.cli_errors import is_json_requested
from fdhil.errors import ConfigError, ConfigFault
from fdhil.store import check_output

DEFAULT_CONFIG = Path("machine.toml")


def _require_default_config(_ctx: click.Context, _param: click.Parameter, value: Path) -> Path:
    if value == DEFAULT_CONFIG and not value.exists():
        fault = ConfigFault("file", "is not in this folder", "name the configuration, or create one with fdhil init")
        raise ConfigError(str(value), [fault])
    return value


# readability is checked when reading: an unreadable file is exit code 3, not a wrong call
FILE = click.Path(path_type=Path, readable=False)
FOLDER = click.Path(path_type=Path, readable=False, file_okay=False)
CONFIG = click.argument("config", type=FILE, default=DEFAULT_CONFIG, callback=_require_default_config)
CONFIG_OPTION = click.option("--config", "config_path", type=FILE, default=DEFAULT_CONFIG, show_default=True,
                             callback=_require_default_config, help="Machine configuration (TOML).")  # fmt: skip
FLEET = click.argument("fleet", type=FILE)
PROGRAM = click.argument("program", type=FILE, metavar="PROGRAM|DEMAND.csv")
MODEL = click.option("--model", "model_path", type=FILE, help="Model file (JSON) with the parameters of each axis.")
FROM_HISTORY = click.option("--from-history", is_flag=True, help="Use the newest validated parameters of the history.")
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Write one JSON document to stdout.")
LINES = click.option("--json", "as_json", is_flag=True, help="Write each log line as a JSON object to stdout.")
COLUMNS = click.option(
    "--columns",
    type=FILE,
    help="Column map (TOML) that assigns signals and units to the columns of a foreign file.",
)


class PositiveFloat(click.FloatRange):
    """A finite number above 0, or within a positive range; rejects nan and infinity, which a FloatRange accepts."""

    def __init__(self, least: float | None = None, most: float | None = None) -> None:
        super().__init__(min=least or 0.0, max=most, min_open=least is None)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number. Raises click.BadParameter for other values."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class OutputFile(click.Path):
    """An output file, checked before the work starts; its name must end in one of ``suffixes``, if any are given."""

    def __init__(self, *suffixes: str) -> None:
        super().__init__(path_type=Path, readable=False)
        self._suffixes = suffixes

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path. Raises OutputError if it is not writable, click.BadParameter for an unknown suffix."""
        path = Path(value)
        if self._suffixes and path.suffix.lower() not in self._suffixes:
            self.fail(f"{value}: the name must end in {', '.join(self._suffixes)}.", param, ctx)
        check_output(path)
        return path


class PictureFile(OutputFile):
    """An image file to write; ``-`` derives its name from the recording."""

    def __init__(self) -> None:
        super().__init__(".png", ".svg", ".pdf")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the path. Raises the errors of :class:`OutputFile`."""
        return Path(value) if str(value) == "-" else super().convert(value, param, ctx)


class ConfigFirstCommand(click.Command):
    """A command whose CONFIG is optional although other arguments follow it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Insert the default CONFIG if the first argument is not a TOML file and the last one would be missing."""
        given = self.make_parser(ctx).parse_args(list(args))[0]
        last = [param for param in self.params if isinstance(param, click.Argument)][-1]
        first, alone = given.get("config"), not isinstance(given.get(last.name or ""), str)
        if isinstance(first, str) and not first.endswith(".toml") and alone:
            args = [str(DEFAULT_CONFIG), *args]
        return super().parse_args(ctx, args)


class WritingCommand(click.Command):
    """A command with output files: refuses to overwrite its inputs or to write a file twice, and reports each file."""

    def invoke(self, ctx: click.Context) -> Any:
        """Compare outputs with inputs, run the command, then report the files that were written."""
        given = [(p, path) for p in self.params for path in _list_paths(ctx.params.get(str(p.name)))]
        for k, (option, path) in enumerate(given):
            for other, there in given[:k] + given[k + 1 :]:
                if isinstance(option.type, OutputFile) and _is_same_file(path, there):
                    text = f"{path} is also named by {other.human_readable_name}; choose another name"
                    raise click.BadParameter(text, ctx, option)
        outputs = [path for option, path in given if isinstance(option.type, OutputFile)]
        before = [_read_file_identity(path) for path in outputs]
        try:
            return super().invoke(ctx)
        finally:  # a command that answers no writes its file as well
            for path, old in zip(outputs, before, strict=True):
                if _read_file_identity(path) != old and (not is_json_requested() or sys.stderr.isatty()):
                    click.echo(f"wrote {path}", err=True)


def _read_file_identity(path: Path) -> tuple[int, int] | None:
    """Return inode and modification time of a regular file, which change when it is written; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return (found.st_ino, found.st_mtime_ns) if stat.S_ISREG(found.st_mode) else None


def _is_same_file(path: Path, there: Path) -> bool:
    """Return whether two names denote one regular file, existing or not yet written."""
    try:
        return path.samefile(there) and path.is_file()
    except OSError:  # missing, or not accessible
        return os.path.realpath(path) == os.path.realpath(there)


def _list_paths(value: Any) -> list[Path]:
    values = value if isinstance(value, tuple) else (value,)
    return [path for path in values if isinstance(path, Path)]
