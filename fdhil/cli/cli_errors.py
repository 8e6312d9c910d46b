"""Converts errors of commands to one sentence or one JSON document, and an exit code."""

import contextlib
import functools
import io
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ParamSpec, TextIO, TypeVar

import click

from fdhil.cli.epilogs import read_epilog
from fdhil.cli.terminal_text import replace_controls
from fdhil.errors import ConfigError, ConfigFault, FdhilError

SCHEMA = "fdhil-error-1"
Given = ParamSpec("Given")
Result = TypeVar("Result")
STOPPED = 130
SURROGATES = re.compile("[\ud800-\udfff]")  # stand for bytes that are not text
STANDARD_ERROR = 2
WRONG_CALL = 2
TROUBLE = 3
COMPLETION = "_FDHIL_COMPLETE"  # set by a shell that requests completions; no command runs then
NO_CACHE = (
    "compiled code can be cached neither next to fdhil nor in this user's home; nothing was started; "
    "set NUMBA_CACHE_DIR to a folder that this user can write"
)


class SuggestingGroup(click.Group):
    """A group that adds the epilog to each command, and suggests the command closest in spelling to an unknown one."""

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return one command with its epilog, or None if the name is unknown."""
        command = self.find_command(ctx, cmd_name)
        if command is not None and command.epilog is None:
            command.epilog = read_epilog(cmd_name if self.name == "cli" else f"{self.name} {cmd_name}")
        return command

    def find_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return one command, or None if the name is unknown."""
        return super().get_command(ctx, cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command named by the first argument. Raises NoSuchCommand with suggestions."""
        try:
            return super().resolve_command(ctx, args)
        except click.NoSuchCommand as error:
            raise click.NoSuchCommand(error.command_name, possibilities=self.list_commands(ctx), ctx=ctx) from None


def run_safely(command: click.Command) -> int:
    """Run a click command and return its exit code; report errors on stderr, or with ``--json`` on stdout."""
    if broken := next((each for each in sys.argv[1:] if SURROGATES.search(each)), None):
        text = f"{broken!a} is not valid text in this computer's encoding, {sys.getfilesystemencoding()}"
        return report_error("BadParameter", f"{text}; rename the file, or retype the argument", WRONG_CALL)
    try:
        result = command.main(standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        _print_error(error.format_message())
        return error.exit_code
    except click.exceptions.Abort:
        return report_error("Stopped", "stopped by the operator", STOPPED)
    except click.ClickException as error:
        return report_error(type(error).__name__, _format_usage_error(error), error.exit_code)
    except ConfigError as error:
        return _report_config_error(error)
    except FdhilError as error:
        return report_error(type(error).__name__, str(error), error.exit_code, _extract_details(error))
    except (SystemExit, BrokenPipeError) as error:
        _discard_output(sys.stdout)
        if isinstance(error, SystemExit) and COMPLETION in os.environ:
            return int(error.code or 0)
        return 0  # the reader closed the pipe; click and rich raise SystemExit then
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        text = f"{place}{error.strerror or error}; nothing more was done, check the disk, the path and its rights"
        report_error(type(error).__name__, text, TROUBLE)
        _discard_output(sys.stdout)  # stdout may be the stream that fails
        return TROUBLE
    except RuntimeError as error:
        if "no locator available" not in str(error):  # numba's words
            raise
        return report_error("NoCache", NO_CACHE, TROUBLE)
    except MemoryError:
        return report_error("MemoryError", "out of memory; give a smaller file, or free memory", TROUBLE)
    return int(result or 0)


def require_delivered_answer(command: Callable[Given, Result]) -> Callable[Given, Result]:
    """Decorate a command whose exit code 0 is an affirmative answer: exit 3 if the output could not be delivered."""

    @functools.wraps(command)
    def run_command(*given: Given.args, **options: Given.kwargs) -> Result:
        try:
            result = command(*given, **options)
            sys.stdout.flush()
        except (BrokenPipeError, SystemExit):  # rich raises the latter
            _discard_output(sys.stdout)
            click.get_current_context().exit(TROUBLE)
        return result

    return run_command


def prepare_streams() -> None:
    """Make the standard streams safe: a terminal without ± shows ?, a closed stream becomes /dev/null.

    Otherwise a bus opened later would get the descriptor of a closed stream, and messages would be sent on the bus.
    Child processes inherit the replacement. A closed standard input reads as ended.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= STANDARD_ERROR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 (open until the process ends)
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def report_error(kind: str, text: str, code: int, details: dict[str, Any] | None = None) -> int:
    """Report an error of class ``kind`` as text or JSON; return its exit code."""
    if is_json_requested():
        document = {"schema": SCHEMA, "error": {"class": kind, "text": text} | (details or {})}
        with contextlib.suppress(OSError):
            click.echo(json.dumps(document))
    else:
        _print_error(f"fdhil: {text}")
    return code


def is_json_requested(arguments: Sequence[str] | None = None) -> bool:
    """Return whether JSON output is requested, even if the options could not be parsed."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    return "--json" in (given[: given.index("--")] if "--" in given else given)


def describe_error(error: FdhilError) -> dict[str, Any]:
    """Return the ``error`` entry of a JSON document."""
    return {"class": type(error).__name__, "text": str(error)} | _extract_details(error)


def _extract_details(error: FdhilError) -> dict[str, Any]:
    # device, line and word, faults of a configuration
    details: dict[str, Any] = {name: value for name, value in vars(error).items() if isinstance(value, str | int)}
    if faults := getattr(error, "faults", None):
        details["faults"] = [asdict(fault) for fault in faults if isinstance(fault, ConfigFault)]
    return details


def _report_config_error(error: ConfigError) -> int:
    if is_json_requested():
        return report_error(type(error).__name__, str(error), error.exit_code, _extract_details(error))
    if len(error.faults) == 1:
        return report_error("", f"{error.source} cannot be used: {error.faults[0]}", error.exit_code)
    _print_error("\n".join([f"fdhil: {error.source} cannot be used:", *(f"  {fault}" for fault in error.faults)]))
    return error.exit_code


def _format_usage_error(error: click.ClickException) -> str:
    context = getattr(error, "ctx", None) or click.get_current_context(silent=True)
    command = context.command_path if context is not None else "fdhil"
    text = " ".join(error.format_message().split()).rstrip(".")
    return f"{text}{'' if text.endswith('?') else ';'} see {command} --help"


def _print_error(text: str) -> None:
    try:
        click.echo(replace_controls(text), err=True)
    except OSError:
        _discard_output(sys.stderr)


def _discard_output(stream: TextIO) -> None:
    # the interpreter would report a failing flush of the stream at exit
    with contextlib.suppress(OSError, ValueError):
        descriptor = os.open(os.devnull, os.O_WRONLY)
        os.dup2(descriptor, stream.fileno())
        os.close(descriptor)
