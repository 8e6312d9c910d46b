"""The second half of ``fdhil commission``: an axis is moved where the operator allows it, and identified."""

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
    from fdhil.pipeline import Known
    from fdhil.records import Notice, Outcome


def try_commissioned(
    machine: MachineConfig, record: CommissioningRecord, asked: Asked, progress: Progress, guide: Guide
) -> dict[str, Any] | None:
    """Try a commissioned axis by moving it; None where nobody allowed that. DriveFault when it is refused."""
    from fdhil.api.compiling import forewarn
    from fdhil.commissioning.trial import Operator, try_axis

    axis, room = record.axis, asked.room
    if room is None:
        asked.say(f"axis {axis} is not tried by moving it: no --room was given, so units, signs and model are unproven")
        return None
    guide.moves = trial_moves(machine, axis, room)

    def report(step: str) -> None:
        if step == "return":
            ask_to_move(f"back by {guide.moves[step]} to where the trial began")
            return
        if guide.moves[step] != NOTHING:
            ask_to_move(guide.moves[step])
        guide(step)

    def ask_to_move(way: str) -> None:
        if not asked.yes:
            advice = "the axis was not moved, its record holds; start again when it may move"
            confirm(axis, f"Now axis {axis} moves {way}. Is its way free, and may it?", advice)

    def result(step: str, found: Found) -> None:
        guide.result(step, found)
        if found.get("return"):
            guide.moves["return"] = found["return"]

    def saw(question: str) -> bool | None:
        return None if asked.yes else agreed(question)

    settings = machine.axis[axis]
    operator = Operator(report, saw, result, lambda mm: guide.show_position(settings.shown(mm, form=".3f")))
    forewarn("identify")
    with _history(machine, axis) as (known, keep):
        tried = try_axis(machine, record, room, operator, progress, known)
        keep(tried.outcomes)
    return dict(tried.found)


def ask_room(axis: str, unit: str) -> Room | None:
    """Ask how far the axis may be moved; None where nobody allows it."""
    question = (
        f"How far may axis {axis} go from here, for a jog and for rapids, in {unit}? Back and forward, as: -20 200; "
        "Enter: not at all"
    )
    said = answered(question)
    words = said.split()
    if not words:
        return None
    try:
        back, forward = map(float, words)
    except ValueError:
        raise DriveFault(f"drive {axis}", f"{said!r} is not two numbers; it was not moved, start again") from None
    return room_of((back, forward))


@contextmanager
def _history(machine: MachineConfig, axis: str) -> Iterator[tuple[Known | None, Callable[[Sequence[Outcome]], None]]]:
    """What the history knows of the axis, and how outcomes get into it.

    Beside a running daemon nothing is written: it hears the rapids itself.
    """
    from fdhil.daemon.lock import BusLocked, sole_owner
    from fdhil.daemon.outcome_store import OutcomeStore
    from fdhil.pipeline import Known

    with ExitStack() as open_:
        try:
            open_.enter_context(sole_owner(machine.run_directory, machine.store.directory))
        except BusLocked:
            yield None, lambda _outcomes: None
            return
        store = OutcomeStore(machine)
        open_.callback(store.close)
        _tell(store.open())
        yield Known(newest=store.known(axis).newest), lambda outcomes: _tell(store.keep(outcomes))


def _tell(notices: Sequence[Notice]) -> None:
    for notice in notices:
        click.echo(f"{notice.code}: {notice.text}", err=True)
