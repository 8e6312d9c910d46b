"""Reports each step of a commissioning and its result to the operator, and asks before anything moves."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from fdhil.cli.commission_steps import NOTHING, result_text
from fdhil.cli.consent import agreed
from fdhil.errors import DriveFault

if TYPE_CHECKING:
    from fdhil.commissioning.progress import Found, Progress, Step
    from fdhil.commissioning.strokes import Room

POSITION_S = 0.2  # a position is shown so often while an axis moves


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
    """Reports each step before it is done, with what it moves, or that it is kept; then its result.

    Steps are counted over the whole commissioning: ``first`` precede these, of ``total``.
    """

    def __init__(
        self, axis: str, asked: Asked, steps: Mapping[str, str], progress: Progress, first: int, total: int
    ) -> None:
        self._axis, self._asked, self._steps, self._first, self._total = axis, asked, steps, first, total
        self.moves: dict[str, str] = {}
        self._shown_s: float | None = None
        progress.on_kept = self.kept

    def __call__(self, step: str) -> None:
        """Report what is done next."""
        self._say(f"{self._head(step)}: {told(self._steps[step], self.moves[step])}")

    def kept(self, name: str, step: Step) -> None:
        """Report that a step need not be done, and what it found."""
        from fdhil.report.parameter_view import minute

        self._say(f"{self._head(name)}: kept, it was done {minute(step.done_utc)}; {result_text(name, step.found)}")

    def result(self, step: str, found: Found) -> None:
        """Report what a step found."""
        self._say(f"axis {self._axis}: {step}: {result_text(step, found)}")

    def show_position(self, text: str) -> None:
        """Show where the moving axis is, on a terminal, in a line that is written over."""
        now_s = time.monotonic()
        if sys.stderr.isatty() and (self._shown_s is None or now_s - self._shown_s >= POSITION_S):
            click.echo(f"\raxis {self._axis} at {text:<24}", err=True, nl=False)
            self._shown_s = now_s

    def _say(self, text: str) -> None:
        if self._shown_s is not None:
            click.echo(f"\r{'':<40}\r", err=True, nl=False)
            self._shown_s = None
        self._asked.say(text)

    def _head(self, step: str) -> str:
        number = self._first + list(self._steps).index(step) + 1
        return f"axis {self._axis}, step {number} of {self._total}, {step}"


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
