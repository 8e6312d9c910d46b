"""Trial of ``fdhil commission``: moves a commissioned axis within the allowed room and identifies it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.commission_guide import Asked, Guide, confirm, room_of
from fdhil.cli.commission_steps import NOTHING, trial_moves
from fdhil.cli.consent import agreed, answered
from fdhil.errors import DriveFault

if TYPE_CHECKING:
    from fdhil.commissioning.progress import Found, Progress
    from fdhil.commissioning.record import CommissioningRecord
    from fdhil.commissioning.strokes import Room
    from fdhil.config import MachineConfig
    from fdhil.pipeline import PipelineState
    from fdhil.records import Notice, Outcome


def try_commissioned(
    machine: MachineConfig, record: CommissioningRecord, options: Asked, progress: Progress, guide: Guide
) -> dict[str, Any] | None:
    """Run the trial of a commissioned axis; None without a room. Raises DriveFault if it is refused."""
    from fdhil.api.compilation_notice import announce_compilation
    from fdhil.commissioning.trial import Operator, try_axis

    axis, room = record.axis, options.room
    if room is None:
        options.say(f"axis {axis}: no trial, because no --room was given; units, signs and model are unproven")
        return None
    guide.moves = trial_moves(machine, axis, room)

    def report(step: str) -> None:
        if step == "return":
            ask_to_move(f"back by {guide.moves[step]} to the start of the trial")
            return
        if guide.moves[step] != NOTHING:
            ask_to_move(guide.moves[step])
        guide(step)

    def ask_to_move(way: str) -> None:
        if not options.yes:
            advice = "the axis was not moved and its record stays valid; start again when it may move"
            confirm(axis, f"Axis {axis} will move {way}. Is its path free? Start?", advice)

    def result(step: str, found: Found) -> None:
        guide.result(step, found)
        if found.get("return"):
            guide.moves["return"] = found["return"]

    def saw(question: str) -> bool | None:
        return None if options.yes else agreed(question)

    settings = machine.axis[axis]
    operator = Operator(report, saw, result, lambda mm: guide.show_position(settings.format_in_unit(mm, form=".3f")))
    announce_compilation("identify")
    with _history(machine, axis) as (known, keep):
        tried = try_axis(machine, record, room, operator, progress, known)
        keep(tried.outcomes)
    return dict(tried.found)


def ask_room(axis: str, unit: str) -> Room | None:
    """Ask for the allowed travel of the axis; None if no motion is allowed."""
    question = (
        f"How far may axis {axis} move from here, for a jog and for rapids, in {unit}? Back and forward, as: -20 200; "
        "Enter: not at all"
    )
    said = answered(question)
    words = said.split()
    if not words:
        return None
    try:
        back, forward = map(float, words)
    except ValueError:
        raise DriveFault(f"drive {axis}", f"{said!r} is not two numbers; the axis was not moved, start again") from None
    return room_of((back, forward))


@contextmanager
def _history(
    machine: MachineConfig, axis: str
) -> Iterator[tuple[PipelineState | None, Callable[[Sequence[Outcome]], None]]]:
    """Yield the history of the axis and a function that stores outcomes.

    While a daemon runs nothing is stored: it records the rapids itself.
    """
    from fdhil.daemon.machine_lock import BusLocked, lock_machine
    from fdhil.daemon.outcome_store import OutcomeStore
    from fdhil.pipeline import PipelineState

    with ExitStack() as open_:
        try:
            open_.enter_context(lock_machine(machine.run_directory, machine.store.directory))
        except BusLocked:
            yield None, lambda _outcomes: None
            return
        store = OutcomeStore(machine)
        open_.callback(store.close)
        _tell(store.open())
        yield (
            PipelineState(newest=store.read_axis_history(axis).newest),
            lambda outcomes: _tell(store.store_outcomes(outcomes)),
        )


def _tell(notices: Sequence[Notice]) -> None:
    for notice in notices:
        click.echo(f"{notice.code}: {notice.text}", err=True)
