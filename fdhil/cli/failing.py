"""Turns an error into one sentence, or one JSON document, and an exit code."""

import contextlib
import functools
import io
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ParamSpec, TextIO, TypeVar

import click

from fdhil.cli.terminal_text import without_controls
from fdhil.errors import ConfigError, ConfigFault, FdhilError

SCHEMA = "fdhil-error-1"
Given = ParamSpec("Given")
Result = TypeVar("Result")
STOPPED = 130
STANDARD_ERROR = 2
WRONG_CALL = 2
TROUBLE = 3
COMPLETION = "_FDHIL_COMPLETE"  # what a shell asks click by for its completion; fdhil runs no command then
NO_CACHE = (
    "compiled code can be kept neither beside fdhil nor in the home of this user; nothing was started; "
    "set NUMBA_CACHE_DIR to a folder that this user may write"
)


class SuggestingGroup(click.Group):
    """A group that names the commands whose spelling is close to an unknown one."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the arguments begin with; NoSuchCommand."""
        try:
            return super().resolve_command(ctx, args)
        except click.NoSuchCommand as error:
            raise click.NoSuchCommand(error.command_name, possibilities=self.list_commands(ctx), ctx=ctx) from None


def run_safely(command: click.Command) -> int:
    """Run a click command and return the exit code; errors are told on stderr, with ``--json`` on stdout."""
    if broken := next((each for each in sys.argv[1:] if not _is_text(each)), None):
        text = f"{broken!a} is no text in this computer's encoding, {sys.getfilesystemencoding()}"
        return tell("BadParameter", f"{text}; rename the file, or write the word anew", WRONG_CALL)
    try:
        result = command.main(standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        _say(error.format_message())
        return error.exit_code
    except click.exceptions.Abort:
        return tell("Stopped", "stopped by the operator", STOPPED)
    except click.ClickException as error:
        return tell(type(error).__name__, _usage(error), error.exit_code)
    except ConfigError as error:
        return _tell_config(error)
    except FdhilError as error:
        return tell(type(error).__name__, str(error), error.exit_code, _details(error))
    except (SystemExit, BrokenPipeError) as error:
        _drop(sys.stdout)
        if isinstance(error, SystemExit) and COMPLETION in os.environ:
            return int(error.code or 0)
        return 0  # whoever read the answer has seen enough of it; click and rich raise SystemExit then
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        text = f"{place}{error.strerror or error}; nothing more was done, check the disk, the path and its rights"
        tell(type(error).__name__, text, TROUBLE)
        _drop(sys.stdout)  # it may be what takes nothing
        return TROUBLE
    except RuntimeError as error:
        if "no locator available" not in str(error):  # numba's words
            raise
        return tell("NoCache", NO_CACHE, TROUBLE)
    except MemoryError:
        return tell("MemoryError", "the memory is used up; give a smaller file, or free memory", TROUBLE)
    return int(result or 0)


def _is_text(argument: str) -> bool:
    """Whether an argument can be told, kept and shown: bytes that are no letters cannot."""
    try:
        argument.encode()
    except UnicodeEncodeError:
        return False
    return True


def verdict(command: Callable[Given, Result]) -> Callable[Given, Result]:
    """Mark a command whose exit code 0 is a yes: where nobody took its answer, it is 3."""

    @functools.wraps(command)
    def run(*given: Given.args, **options: Given.kwargs) -> Result:
        try:
            result = command(*given, **options)
            sys.stdout.flush()
        except (BrokenPipeError, SystemExit):  # rich raises the latter
            _drop(sys.stdout)
            click.get_current_context().exit(TROUBLE)
        return result

    return run


def prepare_streams() -> None:
    """Make standard output and error take whatever is said: a terminal without ± shows ?, a closed one nothing.

    What was closed is /dev/null from here on, also in programs started from here: a bus that was opened in its place
    would be sent what is said. A closed standard input is one that is at its end.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= STANDARD_ERROR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 (for as long as the process lives)
        elif mode == "w" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def tell(kind: str, text: str, code: int, details: dict[str, Any] | None = None) -> int:
    """Tell an error of class ``kind`` to whoever called, a person or a program; return its exit code."""
    if wants_json():
        document = {"schema": SCHEMA, "error": {"class": kind, "text": text} | (details or {})}
        with contextlib.suppress(OSError):
            click.echo(json.dumps(document))
    else:
        _say(f"fdhil: {text}")
    return code


def wants_json(arguments: Sequence[str] | None = None) -> bool:
    """Whether the command was asked for JSON; known also where its options could not be read."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    return "--json" in (given[: given.index("--")] if "--" in given else given)


def error_document(error: FdhilError) -> dict[str, Any]:
    """Return what the ``error`` of a JSON document says."""
    return {"class": type(error).__name__, "text": str(error)} | _details(error)


def _details(error: FdhilError) -> dict[str, Any]:
    """Return what an error knows beside its sentence: the device, the line and word, the faults of a config."""
    known = vars(error)
    told: dict[str, Any] = {name: value for name, value in known.items() if isinstance(value, str | int)}
    if faults := known.get("faults"):
        told["faults"] = [asdict(fault) for fault in faults if isinstance(fault, ConfigFault)]
    return told


def _tell_config(error: ConfigError) -> int:
    if wants_json():
        return tell(type(error).__name__, str(error), error.exit_code, _details(error))
    if len(error.faults) == 1:
        return tell("", f"{error.source} cannot be used: {error.faults[0]}", error.exit_code)
    _say("\n".join([f"fdhil: {error.source} cannot be used:", *(f"  {fault}" for fault in error.faults)]))
    return error.exit_code


def _usage(error: click.ClickException) -> str:
    context = getattr(error, "ctx", None) or click.get_current_context(silent=True)
    command = context.command_path if context is not None else "fdhil"
    text = " ".join(error.format_message().split()).rstrip(".")
    return f"{text}{'' if text.endswith('?') else ';'} see {command} --help"


def _say(text: str) -> None:
    """Say it on standard error; where that takes nothing, the exit code still tells."""
    try:
        click.echo(without_controls(text), err=True)
    except OSError:
        _drop(sys.stderr)


def _drop(stream: TextIO) -> None:
    """Let nothing more be written to a stream that takes nothing: the interpreter would complain at its end."""
    with contextlib.suppress(OSError, ValueError):
        descriptor = os.open(os.devnull, os.O_WRONLY)
        os.dup2(descriptor, stream.fileno())
        os.close(descriptor)
