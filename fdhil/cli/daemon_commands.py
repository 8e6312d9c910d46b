"""``fdhil run`` and the clients of daemon and guard: ``status``, ``arm``, ``disarm``, ``adopt``, ``acknowledge``."""

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
from fdhil.cli.audit_hook import record_answer, record_request
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.operator_prompt import ask_yes_no
from fdhil.cli.options import AS_JSON, CONFIG, FILE, LINES, ConfigFirstCommand
from fdhil.cli.terminal_text import replace_controls
from fdhil.errors import ConnectError, DeviceError, DeviceTimeout, DriveFault

if TYPE_CHECKING:
    from fdhil.arming import GuardClient

DISARM_S = 15.0  # covers the guard's answer and the ramp
WATCH_S = 1.0
UNASKED = "hold the feed and run it again, with --yes without a terminal"


@click.command()
@CONFIG
@click.option(
    "--method",
    type=click.Choice(list(tables.ESTIMATORS)),
    help="Estimator (default: the configuration's, else the best).",
)
@LINES
@require_delivered_answer
def run(config: Path, method: str | None, as_json: bool) -> int:
    """Run the daemon of CONFIG's machine: identify, predict, and correct once armed.

    Writes one line per outcome to stderr, or with --json to stdout. On SIGTERM or Ctrl-C it ramps the correction to
    zero and stops.
    """
    machine = machine_config.load_config(config)
    from fdhil.api import announce_compilation
    from fdhil.daemon import run_daemon_service, write_lines_as_json  # late: --help imports nothing heavy
    from fdhil.drivers import open_machine

    announce_compilation("identify", "predict", "correct")
    with write_lines_as_json(as_json):
        residual = run_daemon_service(machine, open_machine, method)
    return 0 if residual.is_zero else 3


def _ask_daemon(
    config: Path,
    request: Mapping[str, Any],
    timeout_s: float = 10.0,
    progress: Callable[[Mapping[str, Any]], None] | None = None,
) -> dict[str, Any]:
    load = machine_config.load_directories if request["request"] == "disarm" else machine_config.load_config
    from fdhil.daemon import SOCKET_NAME, ask_daemon

    return ask_daemon(load(config).run_directory / SOCKET_NAME, request, timeout_s, progress)


@click.command()
@CONFIG
@click.option("--watch", is_flag=True, help="Repeat every second until Ctrl-C (with --json: one line each).")
@AS_JSON
def status(config: Path, watch: bool, as_json: bool) -> None:
    """Show the status of CONFIG's daemon.

    Lists parameters, windows, frames, guard state and notices.
    """
    if not watch:
        _show_status(config, as_json)
        return
    with suppress(KeyboardInterrupt):
        while True:
            if not as_json:
                click.clear()  # has no effect without a terminal
            try:
                _show_status(config, as_json)
            except (ConnectError, DeviceTimeout) as error:  # the daemon may be restarted meanwhile
                click.echo(replace_controls(str(error)), err=True)
            time.sleep(WATCH_S)


def _show_status(config: Path, as_json: bool) -> None:
    from fdhil.cli.status_view import show_status
    from fdhil.daemon import describe_config_difference

    answer = _ask_daemon(config, {"request": "status"})
    answer["config_difference"] = describe_config_difference(answer, machine_config.load_config(config).digest)
    if as_json:
        click.echo(json.dumps(answer))
    else:
        show_status(answer)


@click.command(cls=ConfigFirstCommand)
@CONFIG
@click.argument("program", type=FILE, required=False)
@click.option("--method", type=click.Choice(list(tables.CORRECTIONS)), help="Correction method (default: the best).")
@click.option("--whole", is_flag=True, help="Arm only after the whole PROGRAM has passed the check.")
@AS_JSON
@require_delivered_answer
def arm(config: Path, program: Path | None, method: str | None, whole: bool, as_json: bool) -> None:
    """Arm the correction of one PROGRAM (or demand CSV) on CONFIG's machine.

    Without PROGRAM, --method flatness applies speed and torque feed-forward online to any program.

    A program longer than 10 s is armed once its first minute has passed the check, which then continues ahead of the
    motion. A later refusal is reported at least one minute ahead, and the correction is ramped to zero before that
    position. Progress goes to stderr (with --json one JSON object per line); Ctrl-C aborts the check. Results of the
    check are reused until program, parameters or configuration change.

    Each arming applies once; nothing is ever armed again automatically.
    """
    if program is None and method != "flatness":
        raise click.UsageError("PROGRAM is missing; only --method flatness works without it")
    machine = machine_config.load_config(config)
    if program is not None:
        os.close(
            os.open(program, os.O_RDONLY | os.O_NONBLOCK)
        )  # a missing file is exit code 3, not a refusal by the daemon
    from fdhil.arming import read_token

    request = {
        "request": "arm",
        "program": None if program is None else str(program.resolve()),
        "method": method,
        "whole": whole,
        "config_digest": machine.digest,
        "token": read_token(machine.run_directory),
    }
    shown = _CheckProgress(as_json)
    answer = _ask_daemon(config, request, 600.0, shown)
    shown.end_line()
    _print_answer(answer, as_json)


class _CheckProgress:
    """Progress of a program check on stderr: one line that is overwritten, or JSON lines."""

    def __init__(self, as_json: bool) -> None:
        self._as_json, self._open = as_json, False

    def __call__(self, progress: Mapping[str, Any]) -> None:
        if self._as_json:
            click.echo(json.dumps({"progress": progress}), err=True)
            return
        minutes, seconds = divmod(int(progress["checked_s"]), 60)
        text = f"checked {minutes}:{seconds:02d} of the program, line {progress['line']}"
        text += f", {progress['times_real_time']:.0f} x real time"
        if progress["refused"]:
            text += f", {progress['refused']} positions refused"
        click.echo(f"\r{text:<78}", err=True, nl=False)
        self._open = True

    def end_line(self) -> None:
        """End an open line."""
        if self._open:
            click.echo(err=True)


@click.command()
@CONFIG
@AS_JSON
@require_delivered_answer
def disarm(config: Path, as_json: bool) -> None:
    """Ramp the correction to zero, disarm, and wait until zero is read back.

    If the daemon does not respond, the guard is contacted directly. If zero is not reached, the residual offset and the
    next action are printed.
    """
    try:
        answer: Mapping[str, Any] = _ask_daemon(config, {"request": "disarm"}, DISARM_S)
    except (ConnectError, DeviceTimeout) as silent:
        answer = _disarm_guard(config, silent)
    with _record_answer_after(config, "disarm at the guard", answer) if "asked" in answer else nullcontext():
        _print_answer(answer, as_json)


@click.command(cls=ConfigFirstCommand)
@CONFIG
@click.argument("numbers", type=int, nargs=-1, metavar="NUMBER...")
@click.option("--all", "everything", is_flag=True, help="Acknowledge all pending notices.")
@click.option("--note", default="", help="Remark to store with the acknowledgement.")
@AS_JSON
def acknowledge(config: Path, numbers: tuple[int, ...], everything: bool, note: str, as_json: bool) -> None:
    """Acknowledge notices of CONFIG's machine by their NUMBERs.

    fdhil status and fdhil history show the numbers. Operator and time are recorded. Nothing is armed or sent.
    """
    if everything == bool(numbers):
        raise click.UsageError("give the numbers of the notices, or --all")
    chosen: dict[str, Any] = {"notices": list(numbers)}
    if everything:
        waiting = _ask_daemon(config, {"request": "status"})["unacknowledged"]["newest"]
        chosen = {"up_to": max((notice["number"] for notice in waiting), default=0)}
    user = os.environ.get("SUDO_USER") or os.environ.get("USER") or f"user {os.getuid()}"
    _print_answer(_ask_daemon(config, {"request": "acknowledge", "by": user, "note": note, **chosen}), as_json)


def _disarm_guard(config: Path, silent: DeviceError) -> Mapping[str, Any]:
    """Disarm at the guard after the daemon failed with ``silent``. Raises ConnectError if the guard fails as well."""
    machine = machine_config.load_directories(config)
    from fdhil.arming import GuardClient, answer_disarm, wait_until_idle

    try:
        with GuardClient(machine.guard_directory) as guard:
            answer = guard.disarm()
            return {**(answer_disarm(wait_until_idle(guard.read_status)) if answer["ok"] else answer), "asked": "guard"}
    except DeviceError as error:
        text = f"{silent}; the guard does not answer either ({error}); the applied offset is unknown"
        raise ConnectError("machine", text) from None


@click.command()
@CONFIG
@click.option("--yes", is_flag=True, help="Do not ask for confirmation.")
@AS_JSON
@require_delivered_answer
def adopt(config: Path, yes: bool, as_json: bool) -> None:
    """Ramp offsets that CONFIG's drives still apply to zero (guard state FROZEN).

    Hold the feed first. Prints the residual offsets, asks for confirmation, then the guard adopts them and ramps them
    to zero. Contacts the guard directly; no daemon is needed.
    """
    if as_json and not yes:
        raise click.UsageError("--json cannot prompt; give --yes as well")
    machine = machine_config.load_directories(config)
    from fdhil.arming import GuardClient, read_token

    def record_and_read_token() -> str:
        found = read_token(machine.run_directory)
        record_request(machine, "adopt")
        return found

    with GuardClient(machine.guard_directory) as guard:
        answer = _adopt_offsets(guard, record_and_read_token, yes, quiet=as_json)
    with _record_answer_after(config, "adopt", answer):
        _print_answer(answer, as_json)


@contextmanager
def _record_answer_after(config: Path, what: str, answer: Mapping[str, Any]) -> Iterator[None]:
    # recorded after it was shown, so that no disk delays it
    try:
        yield
    finally:
        record_answer(machine_config.load_directories(config), what, answer)


def _adopt_offsets(guard: GuardClient, token: Callable[[], str], yes: bool, quiet: bool) -> Mapping[str, Any]:
    from fdhil.arming import answer_disarm, read_residual_offset, wait_until_idle
    from fdhil.guard import AT_REST

    status = guard.read_status()
    residual, state = read_residual_offset(status), status["state"]
    if state not in AT_REST:
        text = f"the guard is {state}, a correction is active"
        return {"ok": False, "code": "NotOff", "text": text, "advice": "run fdhil disarm", "state": state}
    if state == "OFF" and residual.is_zero:
        return answer_disarm(status) | {"text": f"guard: OFF, {residual}; there is nothing to adopt"}
    if not quiet:
        click.echo(f"the guard is {state}: {residual}", err=True)
    if not yes and not ask_yes_no("Is the feed held? Ramp the offset to zero now?"):
        raise DriveFault("adoption", f"not confirmed; nothing was sent; {residual}; {UNASKED}")
    try:
        answer = guard.adopt(token())
        return (
            answer_disarm(wait_until_idle(guard.read_status))
            if answer["ok"]
            else {**answer, "may_stand_um": dict(residual.offset_um)}
        )
    except DeviceError as error:
        raise ConnectError("adoption", f"{error}; {residual}") from None


def _print_answer(answer: Mapping[str, Any], as_json: bool) -> None:
    # exit 1 for a refusal, unless the answer names another exit code
    if difference := answer.get("config_difference"):
        click.echo(replace_controls(difference), err=True)
    if as_json:
        click.echo(json.dumps(answer))
    elif answer["ok"]:
        click.echo(replace_controls(answer.get("text", "done")))
    else:
        advice = f"; {answer['advice']}" if answer.get("advice") else ""
        click.echo(replace_controls(f"refused: {answer['code']}: {answer['text']}{advice}"), err=True)
        for more in answer.get("refused", [])[1:]:
            text = more if isinstance(more, str) else f"{more['code']}: {more['text']}; {more['advice']}"
            click.echo(replace_controls(f"also: {text}"), err=True)
    if not answer["ok"]:
        click.get_current_context().exit(answer.get("exit_code", 1))
