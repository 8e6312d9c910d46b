"""Trial of ``fdhil commission``: moves a commissioned axis within the allowed room and identifies it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.commission_reporter import CommissionOptions, StepReporter, parse_room, require_confirmation
from fdhil.cli.commission_step_texts import NOTHING, describe_trial_motions
from fdhil.cli.operator_prompt import ask_text, ask_yes_no
from fdhil.errors import DriveFault

if TYPE_CHECKING:
    from fdhil.commissioning import CommissioningRecord, Found, StepProgress, TravelRoom
    from fdhil.config import MachineConfig
    from fdhil.pipeline import PipelineState
    from fdhil.records import Notice, Outcome


def run_trial(
    machine: MachineConfig,
    record: CommissioningRecord,
    options: CommissionOptions,
    progress: StepProgress,
    guide: StepReporter,
) -> dict[str, Any] | None:
    """Run the trial of a commissioned axis; None without a room. Raises DriveFault if it is refused."""
    from fdhil.api import announce_compilation
    from fdhil.commissioning import OperatorCallbacks, try_axis

    axis, room = record.axis, options.room
    if room is None:
        options.show_text(f"axis {axis}: no trial, because no --room was given; units, signs and model are unproven")
        return None
    guide.moves = describe_trial_motions(machine, axis, room)

    def report_step(step: str) -> None:
        if step == "return":
            ask_to_move(f"back by {guide.moves[step]} to the start of the trial")
            return
        if guide.moves[step] != NOTHING:
            ask_to_move(guide.moves[step])
        guide(step)

    def ask_to_move(way: str) -> None:
        if not options.yes:
            advice = "the axis was not moved and its record stays valid; start again when it may move"
            require_confirmation(axis, f"Axis {axis} will move {way}. Is its path free? Start?", advice)

    def report_result(step: str, found: Found) -> None:
        guide.report_result(step, found)
        if found.get("return"):
            guide.moves["return"] = found["return"]

    def confirm_observation(question: str) -> bool | None:
        return None if options.yes else ask_yes_no(question)

    settings = machine.axis[axis]
    operator = OperatorCallbacks(
        report_step,
        confirm_observation,
        report_result,
        lambda mm: guide.show_position(settings.format_in_unit(mm, form=".3f")),
    )
    announce_compilation("identify")
    with _open_history(machine, axis) as (known, keep):
        tried = try_axis(machine, record, room, operator, progress, known)
        keep(tried.outcomes)
    return dict(tried.found)


def ask_room(axis: str, unit: str) -> TravelRoom | None:
    """Ask for the allowed travel of the axis; None if no motion is allowed."""
    question = (
        f"How far may axis {axis} move from here, for a jog and for rapids, in {unit}? Back and forward, as: -20 200; "
        "Enter: not at all"
    )
    message = ask_text(question)
    words = message.split()
    if not words:
        return None
    try:
        back, forward = map(float, words)
    except ValueError:
        raise DriveFault(
            f"drive {axis}", f"{message!r} is not two numbers; the axis was not moved, start again"
        ) from None
    return parse_room((back, forward))


@contextmanager
def _open_history(
    machine: MachineConfig, axis: str
) -> Iterator[tuple[PipelineState | None, Callable[[Sequence[Outcome]], None]]]:
    """Yield the history of the axis and a function that stores outcomes.

    While a daemon runs nothing is stored: it records the rapids itself.
    """
    from fdhil.daemon import BusLocked, OutcomeStore, lock_machine
    from fdhil.pipeline import PipelineState

    with ExitStack() as open_:
        try:
            open_.enter_context(lock_machine(machine.run_directory, machine.store.directory))
        except BusLocked:
            yield None, lambda _outcomes: None
            return
        store = OutcomeStore(machine)
        open_.callback(store.close)
        _print_notices(store.open())
        yield (
            PipelineState(newest=store.read_axis_history(axis).newest),
            lambda outcomes: _print_notices(store.store_outcomes(outcomes)),
        )


def _print_notices(notices: Sequence[Notice]) -> None:
    for notice in notices:
        click.echo(f"{notice.code}: {notice.text}", err=True)
