"""``fdhil commission``: commission the drives step by step, and run a trial if the operator allows motion."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fdhil import config as machine_config
from fdhil.cli.audit_hook import audit_action
from fdhil.cli.cli_errors import require_delivered_answer
from fdhil.cli.commission_reporter import (
    CommissionOptions,
    StepReporter,
    describe_step,
    parse_room,
    require_confirmation,
)
from fdhil.cli.commission_step_texts import (
    FEEDFORWARD,
    HAL_STEPS,
    STEPS,
    TRIAL,
    can_run_trial,
    describe_motions,
    describe_trial_motions,
    list_planned_steps,
)
from fdhil.cli.commission_trial import ask_room, run_trial
from fdhil.cli.options import AS_JSON, CONFIG
from fdhil.errors import ConfigError, ConfigFault, DriveFault

if TYPE_CHECKING:
    from types import FrameType

    from fdhil.commissioning import StepProgress
    from fdhil.config import MachineConfig

SCHEMA = "fdhil-commission-1"
NEXT = "next: fdhil run and, in another terminal, fdhil-guard; then switch the NC on and let it make rapids"
NEXT_UNTRIED = f"{NEXT}, which identify the drives (or run fdhil commission --room BACK FORWARD, which moves the axes)"
NEXT_PDOS = "next: fdhil commission"
NEXT_STOPPED = "next: run the same command again; it continues with the unfinished step"
NEXT_REFUSED = "next: correct the cause, then run the same command again; completed steps are kept"


@click.command()
@CONFIG
@click.option("--axis", "only", help="Axis to commission (default: all, one after the other).")
@click.option("--room", nargs=2, type=float, metavar="BACK FORWARD",
              help="Travel allowed from the present position for the trial, mm: -20 200 (default: ask; with --yes: "
              "no trial).")  # fmt: skip
@click.option("--dry-run", is_flag=True, help="Print the effect and the motion of each step; send nothing.")
@click.option("--again", is_flag=True, help="Repeat all steps, including completed ones.")
@click.option(
    "--set-pdos", is_flag=True, help="Only write and save the PDO mapping of the drives' profile; nothing moves."
)
@click.option("--yes", is_flag=True, help="Do not ask before an axis moves or PDOs are written.")
@AS_JSON
@require_delivered_answer
def commission(
    config: Path,
    only: str | None,
    room: tuple[float, float] | None,
    dry_run: bool,
    again: bool,
    set_pdos: bool,
    yes: bool,
    as_json: bool,
) -> int:
    """Commission the drives of CONFIG, step by step, as arming requires.

    Before: switch the NC off, leave the axis free to move by 0.1 mm, and make sure that the machine's safety functions
    are effective.

    Compares the drive's set-up with CONFIG, asks, switches the drive on, moves the axis by 10 um, determines where the
    offset acts, verifies the drive's watchdog, and writes a signed record to the store. With --room the axis is then
    jogged, moved as by G0, identified, and compared with the prediction of the identified model. Each step announces
    its motion first.

    Completed steps are skipped unless the drive or the configuration changed; an interrupted run continues where it
    ended. On any failure and on Ctrl-C the axis is braked, the offset returns to zero and the drive is switched off.
    """
    machine = machine_config.load_config(config)
    # an axis of HAL pins without offsets needs no commissioning
    proven = [name for name, axis in machine.axis.items() if axis.correction is not None or axis.drive.source != "hal"]
    axes = [only] if only else proven or list(machine.axis)
    if axes[0] not in machine.axis:
        fault = ConfigFault("--axis", f"there is no axis {only}", f"one of {', '.join(machine.axis)}")
        raise ConfigError(str(config), [fault])
    options = CommissionOptions(parse_room(room), yes, again, as_json)
    if dry_run:
        return _print_plan(machine, axes, options)
    done: dict[str, Any] = {}
    refused = None
    with _interrupt_on_signals():
        for axis in axes:
            try:
                done[axis] = _set_pdos(machine, axis, options) if set_pdos else _commission_axis(machine, axis, options)
            except DriveFault as fault_found:
                refused = str(fault_found)
                break
            except (KeyboardInterrupt, click.Abort):
                options.show_text(NEXT_STOPPED)
                raise
    if as_json:
        click.echo(json.dumps({"schema": SCHEMA, "axes": done, "refused": refused}))
    if refused is not None:
        click.echo(f"refused: {refused}", err=True)
        options.show_text(NEXT_REFUSED)
    else:
        tried = set_pdos or all(found["trial"] is not None for found in done.values())
        options.show_text(NEXT_PDOS if set_pdos else NEXT if tried else NEXT_UNTRIED)
    return int(refused is not None)


@contextmanager
def _interrupt_on_signals() -> Iterator[None]:
    """Turn SIGTERM and a closed terminal into Ctrl-C: the axis is braked, the offset zeroed, the drive switched off.

    Only the first signal counts: a second one must not interrupt the braking.
    """
    from fdhil.commissioning import handle_signals

    stopping = False

    def interrupt_once(_number: int, _frame: FrameType | None) -> None:
        nonlocal stopping
        if not stopping:
            stopping = True
            raise KeyboardInterrupt

    with handle_signals(interrupt_once):
        yield


def _open_progress(machine: MachineConfig, axis: str) -> StepProgress:
    from fdhil.commissioning import StepProgress

    return StepProgress(machine.store.directory, axis, machine.store.commissioning_key)


def _print_plan(machine: MachineConfig, axes: list[str], options: CommissionOptions) -> int:
    from fdhil.report import format_minute

    plans: dict[str, list[dict[str, Any]]] = {}
    refused = None
    for axis in axes:
        try:
            plans[axis] = list_planned_steps(
                machine, axis, options.room, not options.yes, _open_progress(machine, axis)
            )
        except DriveFault as fault:
            refused = str(fault)
            break
    if options.quiet:
        click.echo(json.dumps({"schema": SCHEMA, "dry_run": True, "axes": plans, "refused": refused}))
    for axis, steps in plans.items():
        options.show_text(f"axis {axis}, planned steps (nothing is sent now):")
        for number, step in enumerate(steps, 1):
            done = (
                f" Done {format_minute(step['done_utc'])}, skipped if the drive is unchanged."
                if step["done_utc"]
                else ""
            )
            options.show_text(
                f"  {number} of {len(steps)}, {step['step']}: {describe_step(step['does'], step['moves'])}{done}"
            )
    if refused is not None:
        click.echo(f"refused: {refused}", err=True)
    return int(refused is not None)


def _commission_axis(machine: MachineConfig, axis: str, options: CommissionOptions) -> dict[str, Any]:
    from fdhil.cli.bus_lock import lock_bus
    from fdhil.commissioning import commission_axis, commission_hal, save_record

    hal = machine.axis[axis].drive.source == "hal"
    progress = _open_progress(machine, axis)
    if progress.rejection:
        click.echo(progress.rejection, err=True)
    if options.again:
        progress.forget_steps()
    if options.room is None and not options.yes and can_run_trial(machine, axis):
        options = replace(options, room=ask_room(axis, machine.axis[axis].unit))
    if options.room is not None and not hal:
        describe_trial_motions(machine, axis, options.room)  # too little room is refused before anything is sent
    bus = machine.bus[machine.axis[axis].drive.bus]
    with (
        lock_bus(bus),
        audit_action(machine, "commission", axis=axis) as ended,
    ):  # the guard reads the record when it starts
        own = HAL_STEPS if hal else STEPS
        total = len(own) + (len(TRIAL) if options.room is not None and not hal else 0)
        guide = StepReporter(axis, options, own, progress, 0, total)
        report = _make_step_callback(machine, axis, options, guide)
        if hal:
            record = commission_hal(machine, axis, report)
        else:
            record = commission_axis(machine, axis, report, progress, guide.report_result)
        path = save_record(record, machine.store.directory, machine.store.commissioning_key)
        ended["text"] = f"record {record.digest[:16]}"
        options.show_text(
            f"axis {axis} is commissioned: moved {record.sign_test_um:+.1f} um, "
            f"{FEEDFORWARD[record.offset_in_feedforward]}, watchdog {record.watchdog}; record {path}"
        )
        further = StepReporter(axis, options, TRIAL, progress, len(own), total)
        tried = None if hal else run_trial(machine, record, options, progress, further)
    return {**asdict(record), "record": str(path), "digest": record.digest, "trial": tried}


def _make_step_callback(
    machine: MachineConfig, axis: str, options: CommissionOptions, guide: StepReporter
) -> Callable[[str], None]:
    guide.moves = describe_motions(machine, axis)

    def report_step(step: str) -> None:
        if step in ("enable", "move") and not options.yes:
            _confirm_first_motion(machine, axis)
        guide(step)

    return report_step


def _set_pdos(machine: MachineConfig, axis: str, options: CommissionOptions) -> dict[str, Any]:
    from fdhil.cli.bus_lock import lock_bus
    from fdhil.commissioning import Master, set_up_pdos
    from fdhil.drivers import load_profile

    profile = load_profile(machine.axis[axis].drive)
    if not options.yes:
        question = f"Write the PDO mapping of profile {profile.name} to drive {axis} and save it there?"
        require_confirmation(axis, question, "nothing was written; start again, with --yes without a terminal")
    bus = machine.bus[machine.axis[axis].drive.bus]
    with lock_bus(bus), audit_action(machine, "set the PDOs up", axis=axis), Master(machine, axis) as master:
        done = set_up_pdos(master)
    written = ", ".join(done.written) or "none, all match the profile"
    kept = {True: ", saved in the drive", False: ", NOT saved: lost when the drive is off", None: ""}[done.saved]
    if not options.quiet:
        click.echo(f"axis {axis}: PDOs written: {written}{kept}")
    return {"pdos_written": list(done.written), "saved": done.saved}


def _confirm_first_motion(machine: MachineConfig, axis: str) -> None:
    from fdhil.commissioning import compute_largest_move_um

    hal = machine.axis[axis].drive.source == "hal"
    question = f"Axis {axis} will move by 10 um, or by 50 um if friction holds it. Is it free to move? Start?"
    if not hal:
        question = (
            f"The set-up of axis {axis} matches. The drive will be switched on and the axis will move by 10 um, then "
            f"up to {compute_largest_move_um(machine, axis):.0f} um back and forward. Is it free to move? Start?"
        )
    if axis[0] + "2" in machine.axis:
        question = f"{axis} is one of two drives of a gantry axis: its beam will be skewed by as much. {question}"
    advice = "nothing was moved or written; start again when it may move, with --yes without a terminal"
    require_confirmation(axis, question, advice)
