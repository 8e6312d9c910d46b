"""Reports the commissioning steps and their results to the operator, and asks before each motion."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click

from fdhil.cli.commission_step_texts import NOTHING, format_result
from fdhil.cli.operator_prompt import ask_yes_no
from fdhil.errors import DriveFault

if TYPE_CHECKING:
    from fdhil.commissioning import CompletedStep, Found, StepProgress, TravelRoom

POSITION_S = 0.2  # period of the position display while an axis moves


@dataclass(frozen=True, slots=True)
class CommissionOptions:
    """Options of ``fdhil commission``; ``quiet``: only the JSON document goes to stdout."""

    room: TravelRoom | None
    yes: bool
    again: bool
    quiet: bool

    def show_text(self, text: str) -> None:
        """Show progress on stdout, or on stderr if that is a terminal and stdout has the JSON document."""
        if not self.quiet:
            click.echo(text)
        elif sys.stderr.isatty():
            click.echo(text, err=True)


class StepReporter:
    """Announces each step with its motion, or that it is skipped, then reports its result.

    Steps are numbered over the whole commissioning: ``first`` steps precede these, ``total`` is their number.
    """

    def __init__(
        self,
        axis: str,
        options: CommissionOptions,
        steps: Mapping[str, str],
        progress: StepProgress,
        first: int,
        total: int,
    ) -> None:
        self._axis, self._asked, self._steps, self._first, self._total = axis, options, steps, first, total
        self.moves: dict[str, str] = {}
        self._shown_s: float | None = None
        progress.on_reused = self.report_kept_step

    def __call__(self, step: str) -> None:
        """Announce the next step."""
        self._show_line(f"{self._format_heading(step)}: {describe_step(self._steps[step], self.moves[step])}")

    def report_kept_step(self, name: str, step: CompletedStep) -> None:
        """Report that a completed step is skipped, with its result."""
        from fdhil.report import format_minute

        self._show_line(
            f"{self._format_heading(name)}: skipped, done {format_minute(step.done_utc)}; "
            f"{format_result(name, step.found)}"
        )

    def report_result(self, step: str, found: Found) -> None:
        """Report the result of a step."""
        self._show_line(f"axis {self._axis}: {step}: {format_result(step, found)}")

    def show_position(self, text: str) -> None:
        """Show the position of the moving axis in one line of a terminal that is overwritten."""
        now_s = time.monotonic()
        if sys.stderr.isatty() and (self._shown_s is None or now_s - self._shown_s >= POSITION_S):
            click.echo(f"\raxis {self._axis} at {text:<24}", err=True, nl=False)
            self._shown_s = now_s

    def _show_line(self, text: str) -> None:
        if self._shown_s is not None:
            click.echo(f"\r{'':<40}\r", err=True, nl=False)
            self._shown_s = None
        self._asked.show_text(text)

    def _format_heading(self, step: str) -> str:
        number = self._first + list(self._steps).index(step) + 1
        return f"axis {self._axis}, step {number} of {self._total}, {step}"


def describe_step(does: str, moves: str) -> str:
    """Return the description of a step with its motion, if any."""
    return does if moves == NOTHING else f"{does} Moves {moves}."


def parse_room(given: tuple[float, float] | None) -> TravelRoom | None:
    """Return the allowed travel, back and forward, mm or degrees. Raises click.BadParameter if it is invalid."""
    from fdhil.commissioning import TravelRoom

    if given is None:
        return None
    back, forward = given
    if not (-1e4 <= back <= 0.0 <= forward <= 1e4):
        raise click.BadParameter("--room needs the travel back (0 or less) and forward (0 or more) in mm or degrees")
    return TravelRoom(back, forward)


def require_confirmation(axis: str, question: str, advice: str) -> None:
    """Ask the operator. Raises DriveFault unless confirmed; ``advice`` states the state and the next action."""
    if not ask_yes_no(question):
        raise DriveFault(f"drive {axis}", f"not confirmed; {advice}")
