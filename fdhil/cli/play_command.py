"""``fdhil play``: stream a program or demand to the drives of a test bench without NC."""

from __future__ import annotations

import json
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cli.audit_hook import audit_action
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.operator_prompt import ask_yes_no, wait_for_bus_watch
from fdhil.cli.options import AS_JSON, CONFIG_OPTION, FILE
from fdhil.cli.terminal_text import print_progress
from fdhil.errors import DeviceError, DriveFault
from fdhil.guard import SOCKET_NAME

if TYPE_CHECKING:
    from fdhil.commissioning import Bench, CommissioningRecord, PlaybackPlan, PlaybackResult, SetPointGenerator
    from fdhil.config import MachineConfig

NOBODY = "standard input has ended, so Enter cannot be pressed; nothing was played; run it without --hold"
MARKED_S = 1.0  # a running daemon marks a record within this time
SIGNALS: Mapping[int, str] = {
    signal.SIGINT: "stopped by Ctrl-C",
    signal.SIGTERM: "stopped by SIGTERM",
    signal.SIGHUP: "the terminal was closed",
    signal.SIGQUIT: "stopped by Ctrl-\\",
}


@click.command()
@click.argument("program", type=FILE)
@CONFIG_OPTION
@click.option("--go-to-start", is_flag=True, help="Move slowly to the first set-point before the start.")
@click.option(
    "--hold", is_flag=True, help="Hold the axes at the start until Enter is pressed, so that a correction can be armed."
)
@click.option("--dry-run", is_flag=True, help="Check the program and print the motion, without opening a bus.")
@click.option("--yes", is_flag=True, help="Do not ask before the axes move.")
@AS_JSON
@require_delivered_answer
def play(
    program: Path, config_path: Path, go_to_start: bool, hold: bool, dry_run: bool, yes: bool, as_json: bool
) -> int:
    """Stream PROGRAM (NC program or demand CSV) to the drives of a test bench without NC.

    The axes move: fdhil produces SYNC, switches the drives on and sends the set-points. No other master may run the
    bus. Every axis must be commissioned and have [axis.X.setpoints] with its travel, and you must confirm the start.

    A program beyond the limits is refused before anything is sent. Ctrl-C and SIGTERM brake the axes and switch the
    drives off. If fdhil fails, the drives miss its heartbeat and stop by themselves. A correction can be armed
    meanwhile.
    """
    machine = machine_config.load_config(config_path)
    from fdhil.commissioning import plan_playback
    from fdhil.program import load_trajectory

    try:
        plan = plan_playback(machine, load_trajectory(program, machine), str(config_path))
        if not as_json or dry_run:
            click.echo(_describe_plan(plan, program), err=as_json)
        if dry_run:
            _print_document(as_json, {"would_play": True, "rows": int(plan.trajectory.time_s.size)})
            return 0
        played = _run_play(machine, plan, program, go_to_start, hold, yes)
    except DriveFault as fault:
        click.echo(f"refused: {fault}", err=True)
        _print_document(as_json, {"refused": str(fault)})
        return 1
    _print_result(played, plan, as_json)
    return int(played.stopped is not None)


def _run_play(
    machine: MachineConfig, plan: PlaybackPlan, program: Path, go_to_start: bool, hold: bool, yes: bool
) -> PlaybackResult:
    from fdhil.arming import GuardPresence
    from fdhil.cli.bus_lock import lock_bus_part
    from fdhil.commissioning import load_valid_records, lock_realtime_resources, open_bench

    records = load_valid_records(machine)
    with ExitStack() as held, _raise_on_signals():
        for name in dict.fromkeys(axis.drive.bus for axis in machine.axis.values()):
            held.enter_context(lock_bus_part(machine.bus[name], "set-points"))
        held.enter_context(lock_realtime_resources())
        bench = held.enter_context(open_bench(plan, print_progress, GuardPresence(machine.guard_directory).is_present))
        bench.compare_drives(records)
        here = bench.read_positions()
        bench.require_start(here, go_to_start)
        if not yes:
            _confirm_motion(bench, program, here)
        ended = held.enter_context(audit_action(machine, "play", program=str(program)))
        with bench.hold_drives_enabled(lambda: _confirm_records(machine, records, bench.find_axes_without_reboot)):
            stopped = bench.go_to_start(_brake_on_signals, go_to_start)
            if stopped is not None:
                raise DriveFault("the move to the start", f"{stopped}; nothing was played")
            if hold:
                click.echo("holding at the start: press Enter to begin", err=True)
            played = (
                bench.play_demand(_brake_on_signals, _is_enter_pressed)
                if hold
                else bench.play_demand(_brake_on_signals)
            )
        ended["text"] = played.stopped or f"{played.rows} set-points, to the end"
        return played


def _is_enter_pressed() -> bool:
    if sys.stdin is None or sys.stdin.closed:
        raise DriveFault("the bench", NOBODY)
    if not select.select([sys.stdin], (), (), 0.0)[0]:
        return False
    if not sys.stdin.readline():
        raise DriveFault("the bench", NOBODY)
    wait_for_bus_watch()
    return True


def _confirm_records(
    machine: MachineConfig, records: Mapping[str, CommissioningRecord], as_compared: Callable[[], set[str]]
) -> None:
    """Confirm the commissioning records of the drives that have not rebooted; the write to 0x1016 was ours.

    The doubts of the guard and of the store are read before each comparison, so later doubts remain.
    """
    from fdhil.commissioning import clear_void_mark, read_void_mark

    try:
        refused = _report_to_guard(machine, records, as_compared)
        marks = {axis: read_void_mark(machine.store.directory, axis) for axis in records}
        holding = as_compared()
    except DeviceError as error:
        click.echo(f"the guard could not be informed of the comparison of the drives: {error}", err=True)
        return
    for axis in sorted({*records} - holding):
        text = f"axis {axis}: its drive rebooted after the comparison, so nothing can be armed there"
        click.echo(f"RecordVoid: {text}; switch the NC off and run fdhil check", err=True)
    for each in refused:
        click.echo(f"{each['code']}: {each['text']}; {each['advice']}", err=True)
    if all(each["axis"] for each in refused):  # otherwise the guard accepted none of it
        for axis in holding - {each["axis"] for each in refused}:
            clear_void_mark(machine.store.directory, axis, marks[axis])


def _report_to_guard(
    machine: MachineConfig, records: Mapping[str, CommissioningRecord], as_compared: Callable[[], set[str]]
) -> Sequence[Mapping[str, str]]:
    """Report the compared drives to a running guard; return its refusals. Raises DeviceError."""
    from fdhil.arming import GuardClient, get_operator_token

    directory = machine.guard_directory
    if not (directory / SOCKET_NAME).exists():
        return []
    token = get_operator_token(machine.run_directory)
    with GuardClient(directory) as guard:
        touched = guard.read_touch_counts(token)
        answer = guard.report_comparison(token, {axis: records[axis].fingerprint for axis in as_compared()}, touched)
    time.sleep(MARKED_S)
    return list(answer.get("refused", []))


@contextmanager
def _raise_on_signals() -> Iterator[None]:
    # while the axes stand, SIGTERM and a closed terminal act like Ctrl-C
    from fdhil.commissioning import handle_signals

    with handle_signals(signal.default_int_handler):
        yield


@contextmanager
def _brake_on_signals(path: SetPointGenerator) -> Iterator[None]:
    # while the axes move, every signal brakes them
    from fdhil.commissioning import handle_signals

    with handle_signals(lambda number, _frame: path.brake_to_rest(SIGNALS[number])):
        yield


def _describe_plan(plan: PlaybackPlan, program: Path) -> str:
    trajectory = plan.trajectory
    lines = [
        f"{program.name}: {trajectory.time_s.size} set-points, {trajectory.time_s[-1] - trajectory.time_s[0]:.3f} s"
    ]
    for axis, path in trajectory.position_mm.items():
        speed = abs(path[1:] - path[:-1]).max(initial=0.0) / trajectory.dt_s
        ends, least, most = path[[0, -1]], path.min(), path.max()
        first, last, low, high = (plan.config.axis[axis].format_in_unit(mm, form=".3f") for mm in (*ends, least, most))
        fastest = plan.config.axis[axis].format_in_unit(speed, "/s", ".1f")
        lines.append(f"  {axis} from {first} to {last}, between {low} and {high}, at up to {fastest}")
    return "\n".join(lines)


def _confirm_motion(bench: Bench, program: Path, here: list[int]) -> None:
    ways = zip(bench.plan.axes, bench.compute_distance_to_start_mm(here), strict=True)
    shown = {axis: bench.plan.config.axis[axis] for axis in bench.plan.axes}
    start = ", ".join(f"{axis} {shown[axis].format_in_unit(way, form='+.3f')}" for axis, way in ways if way)
    first = f"First the axes move slowly to the start ({start}). " if start else ""
    question = (
        f"The drives match their commissioning. {first}Then {program.name} is played. "
        "Is everybody clear of the machine, and the emergency stop within reach? Start?"
    )
    if not ask_yes_no(question):
        raise DriveFault("the bench", "not confirmed; nothing moved; start again, with --yes without a terminal")


def _print_document(as_json: bool, more: Mapping[str, Any]) -> None:
    if as_json:
        click.echo(json.dumps({"schema": "fdhil-play-1", **more}))


def _print_result(played: PlaybackResult, plan: PlaybackPlan, as_json: bool) -> None:
    late = played.lateness
    sync = {
        "period_s": plan.trajectory.dt_s,
        "cycles": late.cycles,
        "late_p50_us": late.compute_quantile_us(0.5),
        "late_p99_us": late.compute_quantile_us(0.99),
        "late_max_us": round(late.most_us, 1),
        "skipped": late.skipped,
        "scheduling": played.scheduling,
    }
    _print_document(as_json, {"rows": played.of, "played": played.rows, "stopped": played.stopped, "sync": sync})
    if as_json:
        return
    how = ": ".join(filter(None, (played.stopped, played.left))) if played.stopped else "played to its end"
    click.echo(f"{played.rows} of {played.of} set-points, {how}")
    click.echo(
        f"SYNC left late by {sync['late_p50_us']:.0f} us (half of them), {sync['late_p99_us']:.0f} us (99 %), "
        f"{sync['late_max_us']:.0f} us (worst of {late.cycles}); {late.skipped} periods missed; {played.scheduling}"
    )
