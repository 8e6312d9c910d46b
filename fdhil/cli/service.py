"""``fdhil run``, and what talks to it or the guard: ``status``, ``arm``, ``disarm``, ``adopt``, ``acknowledge``."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil import tables
from fdhil.cli.audited import write_after, write_before
from fdhil.cli.consent import agreed
from fdhil.cli.failing import verdict
from fdhil.cli.options import AS_JSON, CONFIG, FILE, LINES, ConfigFirst
from fdhil.cli.terminal_text import without_controls
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, DriveFault

if TYPE_CHECKING:
    from fdhil.arming.guard_client import GuardClient

DISARM_S = 15.0  # the daemon waits for the guard's answer and for the ramp
WATCH_S = 1.0
UNASKED = "hold the feed and run it again, with --yes where nobody can be asked"


@click.command()
@CONFIG
@click.option("--method", type=click.Choice(list(tables.ESTIMATORS)), help="Left out: the config's, else the best.")
@LINES
@verdict
def run(config: Path, method: str | None, as_json: bool) -> int:
    """Run the daemon of the machine in CONFIG: listen, identify, predict; correct only when armed.

    Writes one line per outcome to stderr, with --json to stdout. Stops on SIGTERM or Ctrl-C, with the correction ramped
    to zero first. Exit 3 when an offset may still be applied then: the last line says which, and what to do.
    """
    machine = machine_config.load(config)
    from fdhil.api.compiling import forewarn
    from fdhil.daemon import journal, service  # late: --help imports nothing heavy
    from fdhil.drivers import open_machine

    forewarn("identify", "predict", "correct")
    with journal.lines_as_json(as_json):
        stands = service.run(machine, open_machine, method)
    return 0 if stands.nothing else 3


def _ask(
    config: Path,
    request: Mapping[str, Any],
    timeout_s: float = 10.0,
    progress: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    load = machine_config.load_places if request["request"] == "disarm" else machine_config.load
    from fdhil.daemon.control import SOCKET_NAME, ask

    return ask(load(config).run_directory / SOCKET_NAME, request, timeout_s, progress)


@click.command()
@CONFIG
@click.option("--watch", is_flag=True, help="Show it again each second until Ctrl-C; with --json, a line each.")
@AS_JSON
def status(config: Path, watch: bool, as_json: bool) -> None:
    """Show the status of CONFIG's daemon: parameters, windows, frames, guard, notices."""
    if not watch:
        _show_status(config, as_json)
        return
    with suppress(KeyboardInterrupt):
        while True:
            if not as_json:
                click.clear()  # of a terminal; elsewhere one status follows the other
            try:
                _show_status(config, as_json)
            except (ConnectError, DeviceTimeout) as error:  # the daemon may be restarted meanwhile
                click.echo(without_controls(str(error)), err=True)
            time.sleep(WATCH_S)


def _show_status(config: Path, as_json: bool) -> None:
    from fdhil.cli.status_view import show
    from fdhil.daemon.status import config_difference

    answer = _ask(config, {"request": "status"})
    answer["config_difference"] = config_difference(answer, machine_config.load(config).digest)
    if as_json:
        click.echo(json.dumps(answer))
    else:
        show(answer)


@click.command(cls=ConfigFirst)
@CONFIG
@click.argument("program", type=FILE, required=False)
@click.option("--method", type=click.Choice(list(tables.CORRECTIONS)), help="Left out: the best there is.")
@click.option("--whole", is_flag=True, help="Arm only when all of a long PROGRAM has passed, however long that takes.")
@AS_JSON
@verdict
def arm(config: Path, program: Path | None, method: str | None, whole: bool, as_json: bool) -> None:
    """Arm the correction of one PROGRAM (or demand CSV) on the machine of CONFIG.

    Without PROGRAM, --method flatness feeds speed and torque forward on line, whatever runs.

    A program longer than 10 s is armed when all of it, or its first minute, has passed the check, which then goes on
    ahead of the motion: what it refuses later is told at least a minute ahead, and the correction ramped to zero before
    that place. How far the check is goes to stderr (with --json one JSON object per line); Ctrl-C abandons it. What was
    checked is not checked again until program, parameters or config change.

    Exit 1 with class, cause and next action when it is refused. Nothing is armed again by itself, ever.
    """
    if program is None and method != "flatness":
        raise click.UsageError("only --method flatness needs no PROGRAM; name the program to correct")
    machine = machine_config.load(config)
    if program is not None:
        os.close(os.open(program, os.O_RDONLY | os.O_NONBLOCK))  # a missing file is trouble, not the daemon's no
    from fdhil.arming.token import read_token

    request = {
        "request": "arm",
        "program": None if program is None else str(program.resolve()),
        "method": method,
        "whole": whole,
        "config_digest": machine.digest,
        "token": read_token(machine.run_directory),
    }
    shown = _Shown(as_json)
    answer = _ask(config, request, 600.0, shown)
    shown.end()
    _tell(answer, as_json)


class _Shown:
    """The progress of a check on stderr: one line that is written over, or JSON lines."""

    def __init__(self, as_json: bool) -> None:
        self._as_json, self._open = as_json, False

    def __call__(self, told: Mapping[str, Any]) -> None:
        if self._as_json:
            click.echo(json.dumps({"progress": told}), err=True)
            return
        minutes, seconds = divmod(int(told["checked_s"]), 60)
        text = f"checked {minutes}:{seconds:02d} of the program, line {told['line']}"
        text += f", {told['times_real_time']:.0f} x real time"
        if told["refused"]:
            text += f", {told['refused']} places refused"
        click.echo(f"\r{text:<78}", err=True, nl=False)
        self._open = True

    def end(self) -> None:
        """Begin a new line where one is open."""
        if self._open:
            click.echo(err=True)


@click.command()
@CONFIG
@AS_JSON
@verdict
def disarm(config: Path, as_json: bool) -> None:
    """Ramp the correction to zero, disarm, and wait until zero is read back.

    Where the daemon does not answer, the guard itself is asked. Exit 1 when zero is not reached: what may still be
    applied is told, and what to do.
    """
    try:
        answer: Mapping[str, Any] = _ask(config, {"request": "disarm"}, DISARM_S)
    except (ConnectError, DeviceTimeout) as silent:
        answer = _disarm_at_the_guard(config, silent)
    with _written_after(config, "disarm at the guard", answer) if "asked" in answer else nullcontext():
        _tell(answer, as_json)


@click.command(cls=ConfigFirst)
@CONFIG
@click.argument("numbers", type=int, nargs=-1, metavar="NUMBER...")
@click.option("--all", "everything", is_flag=True, help="All that wait now.")
@click.option("--note", default="", help="A remark that is kept with it.")
@AS_JSON
def acknowledge(config: Path, numbers: tuple[int, ...], everything: bool, note: str, as_json: bool) -> None:
    """Acknowledge notices of CONFIG's machine by their NUMBERs, which fdhil status and fdhil history show.

    It is kept who did and when. It says that somebody has seen them: nothing is armed and nothing is sent.
    """
    if everything == bool(numbers):
        raise click.UsageError("name the notices by their numbers, or give --all")
    chosen: dict[str, Any] = {"notices": list(numbers)}
    if everything:
        waiting = _ask(config, {"request": "status"})["unacknowledged"]["newest"]
        chosen = {"up_to": max((notice["number"] for notice in waiting), default=0)}
    _tell(_ask(config, {"request": "acknowledge", "by": _user(), "note": note, **chosen}), as_json)


def _user() -> str:
    return os.environ.get("SUDO_USER") or os.environ.get("USER") or f"user {os.getuid()}"


def _disarm_at_the_guard(config: Path, silent: DeviceError) -> Mapping[str, Any]:
    """Ask the guard without the daemon; ``silent`` is why. ConnectError when neither answers."""
    machine = machine_config.load_places(config)
    from fdhil.arming.guard_client import GuardClient
    from fdhil.arming.standing import landed, verdict

    try:
        with GuardClient(machine.guard_directory) as guard:
            answer = guard.disarm()
            return {**(verdict(landed(guard.status)) if answer["ok"] else answer), "asked": "guard"}
    except DeviceError as error:
        text = f"{silent}; nor does the guard answer ({error}): it is unknown what is applied"
        raise ConnectError("machine", text) from None


@click.command()
@CONFIG
@click.option("--yes", is_flag=True, help="Do not ask.")
@AS_JSON
@verdict
def adopt(config: Path, yes: bool, as_json: bool) -> None:
    """Take over the offsets that CONFIG's drives still apply (the guard's state FROZEN), and ramp them to zero.

    Says what may still be applied, asks, and has the guard take it over and ramp it to zero. The guard is asked itself:
    no daemon is needed. Hold the feed first. Exit 0 only when zero was read back, 1 when the guard refuses or zero is
    not reached, 3 without a guard or when nobody says yes.
    """
    if as_json and not yes:
        raise click.UsageError("--json cannot ask: give --yes too")
    machine = machine_config.load_places(config)
    from fdhil.arming.guard_client import GuardClient
    from fdhil.arming.token import read_token

    def token() -> str:
        found = read_token(machine.run_directory)
        write_before(machine, "adopt")
        return found

    with GuardClient(machine.guard_directory) as guard:
        answer = _adopted(guard, token, yes, quiet=as_json)
    with _written_after(config, "adopt", answer):
        _tell(answer, as_json)


@contextmanager
def _written_after(config: Path, what: str, answer: Mapping[str, Any]) -> Iterator[None]:
    """Have an answer in the audit after it was told: no disk delays it."""
    try:
        yield
    finally:
        write_after(machine_config.load_places(config), what, answer)


def _adopted(guard: GuardClient, token: Callable[[], str], yes: bool, quiet: bool) -> Mapping[str, Any]:
    """Have what stands ramped to zero, where anything does and the operator wants it; return the answer."""
    from fdhil.arming.standing import landed, standing, verdict
    from fdhil.guard.protocol import AT_REST

    status = guard.status()
    stands, state = standing(status), status["state"]
    if state not in AT_REST:
        text = f"the guard is {state}, a correction is on"
        return {"ok": False, "code": "NotOff", "text": text, "advice": "run fdhil disarm", "state": state}
    if state == "OFF" and stands.nothing:
        return verdict(status) | {"text": f"guard: OFF, {stands}: there is nothing to adopt"}
    if not quiet:
        click.echo(f"the guard is {state}: {stands}", err=True)
    if not yes and not agreed("Is the feed held? Ramp it to zero now?"):
        raise DriveFault("adoption", f"not confirmed; nothing was sent; {stands}; {UNASKED}")
    try:
        answer = guard.adopt(token())
        return verdict(landed(guard.status)) if answer["ok"] else {**answer, "may_stand_um": dict(stands.offset_um)}
    except DeviceError as error:
        raise ConnectError("adoption", f"{error}; {stands}") from None


def _tell(answer: Mapping[str, Any], as_json: bool) -> None:
    """Show an answer; exit 1 when it is no, or as the answer says where something could not be read."""
    if difference := answer.get("config_difference"):
        click.echo(without_controls(difference), err=True)
    if as_json:
        click.echo(json.dumps(answer))
    elif answer["ok"]:
        click.echo(without_controls(answer.get("text", "done")))
    else:
        advice = f"; {answer['advice']}" if answer.get("advice") else ""
        click.echo(without_controls(f"refused: {answer['code']}: {answer['text']}{advice}"), err=True)
        for more in answer.get("refused", [])[1:]:
            told = more if isinstance(more, str) else f"{more['code']}: {more['text']}; {more['advice']}"
            click.echo(without_controls(f"also: {told}"), err=True)
    if not answer["ok"]:
        click.get_current_context().exit(answer.get("exit_code", 1))
