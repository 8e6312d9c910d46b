"""Tells the operator of each step of a commissioning, and asks before anything moves."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from fdhil.cli.commission_steps import NOTHING
from fdhil.cli.consent import agreed
from fdhil.errors import DriveFault

if TYPE_CHECKING:
    from fdhil.commissioning.progress import Progress, Step
    from fdhil.commissioning.strokes import Room


@dataclass(frozen=True, slots=True)
class Asked:
    """What the operator asked for; ``quiet``: only the JSON document goes to stdout."""

    room: Room | None
    yes: bool
    again: bool
    quiet: bool

    def say(self, text: str) -> None:
        """Show progress: on stdout, or on a terminal beside the JSON document."""
        if not self.quiet:
            click.echo(text)
        elif sys.stderr.isatty():
            click.echo(text, err=True)


class Guide:
    """Tells of each step before it is done, with what it moves, or that it is kept."""

    def __init__(
        self, axis: str, asked: Asked, steps: Mapping[str, str], moves: Mapping[str, str], progress: Progress
    ) -> None:
        self._axis, self._asked, self._steps, self._moves = axis, asked, steps, moves
        progress.on_kept = self.kept

    def __call__(self, step: str) -> None:
        """Tell what is done next."""
        self._asked.say(f"{self._head(step)}: {told(self._steps[step], self._moves[step])}")

    def kept(self, name: str, step: Step) -> None:
        """Tell that a step need not be done."""
        self._asked.say(f"{self._head(name)}: kept, it was done {step.done_utc}.")

    def _head(self, step: str) -> str:
        return f"axis {self._axis}, step {list(self._steps).index(step) + 1} of {len(self._steps)}, {step}"


def told(does: str, moves: str) -> str:
    """Return what a step does, and what it moves where it moves something."""
    return does if moves == NOTHING else f"{does} Moves {moves}."


def room_of(given: tuple[float, float] | None) -> Room | None:
    """Return the room that was given, mm or degrees back and forward; click.BadParameter where it is none."""
    from fdhil.commissioning.strokes import Room

    if given is None:
        return None
    back, forward = given
    if not (-1e4 <= back <= 0.0 <= forward <= 1e4):
        text = (
            "--room wants two numbers of mm (or degrees), 0 or less and 0 or more: how far it may go back, and forward"
        )
        raise click.BadParameter(text)
    return Room(back, forward)


def confirm(axis: str, question: str, advice: str) -> None:
    """DriveFault unless the operator says yes; ``advice`` says how things stand then, and what to do."""
    if not agreed(question):
        raise DriveFault(f"drive {axis}", f"not confirmed; {advice}")
