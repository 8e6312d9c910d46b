"""Types of option values that several commands share."""

from __future__ import annotations

import math
from typing import Any

import click


class Positive(click.FloatRange):
    """A finite number above 0: nan, which no range refuses, and infinity are wrong too."""

    def __init__(self) -> None:
        super().__init__(min=0.0, min_open=True)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; click.BadParameter where it is none."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number.", param, ctx)
        return number
