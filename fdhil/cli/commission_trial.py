"""The second half of ``fdhil commission``: an axis is moved where the operator allows it, and identified."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import click

from fdhil.cli.commission_guide import Asked, Guide, confirm, room_of
from fdhil.cli.commission_steps import NOTHING, TRIAL, trial_moves
from fdhil.cli.consent import agreed, answered
from fdhil.errors import DriveFault

if TYPE_CHECKING:
    from fdhil.commissioning.progress import Progress
    from fdhil.commissioning.record import CommissioningRecord
    from fdhil.commissioning.strokes import Room
    from fdhil.config import MachineConfig
    from fdhil.pipeline import Known
    from fdhil.records import Notice, Outcome


def try_commissioned(
    machine: MachineConfig, record: CommissioningRecord, asked: Asked, progress: Progress
) -> dict[str, Any] | None:
    """Try a commissioned axis by moving it; None where nobody allowed that. DriveFault when it is refused."""
    from fdhil.api.compiling import forewarn
    from fdhil.commissioning.trial import Operator, try_axis

    axis = record.axis
    gantry = axis[0] + "2" in machine.axis  # of whose drives none is moved alone
    room = asked.room or (None if asked.yes or gantry else _asked_room(axis, machine.axis[axis].unit))
    if room is None:
        asked.say(f"axis {axis} is not tried by moving it: no --room was given, so units, signs and model are unproven")
        return None
    moves = trial_moves(machine, axis, room)
    guide = Guide(axis, asked, TRIAL, moves, progress)

    def report(step: str) -> None:
        if moves[step] != NOTHING and not asked.yes:
            advice = "the axis was not moved, its record holds; start again when it may move"
            confirm(axis, f"Now axis {axis} moves {moves[step]}. Is its way free, and may it?", advice)
        guide(step)

    def saw(question: str) -> bool | None:
        return None if asked.yes else agreed(question)

    forewarn("identify")
    with _history(machine, axis) as (known, keep):
        tried = try_axis(machine, record, room, Operator(report, saw), progress, known)
        keep(tried.outcomes)
    for line in _told(tried.found):
        asked.say(f"axis {axis}: {line}")
    return dict(tried.found)


def _asked_room(axis: str, unit: str) -> Room | None:
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


def _told(found: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    for step, values in found.items():
        if step == "identification":
            shown = [f"{name} {_figure(value)}" for name, value in values.items()]
        elif step == "acceptance":
            shown = [
                f"following error {move['measured_rms_um']:.2f} um RMS, predicted to {move['left_rms_um']:.2f}"
                for move in values["moves"]
            ]
        else:
            shown = [f"{name} {value}" for name, value in values.items()]
        yield f"{step}: {', '.join(shown)}"


def _figure(value: Mapping[str, Any]) -> str:
    if value["std"] is None:
        return f"{value['value']:.4g} {value['unit']} (the data sheet's)"
    return f"{value['value']:.4g} ± {value['std']:.2g} {value['unit']}"
