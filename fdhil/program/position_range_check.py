"""Find the first row of a demand whose set-points exceed the 32-bit range of a drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fdhil.config import MachineConfig, PositionRange
from fdhil.records import Float


class OutOfRange(NamedTuple):
    """A row outside the range of an axis, and the message about it."""

    row: int
    axis: str
    text: str


def find_first_out_of_range(position_mm: Mapping[str, Float], config: MachineConfig) -> OutOfRange | None:
    """Return the first row at which an axis is out of range; None if all (n,) positions fit."""
    found = []
    for name, axis in config.axis.items():
        reach = PositionRange.build_for_axis(name, axis, config.machine.sync_period_s)
        increments = np.rint(position_mm[name] * reach.per_mm)
        out = np.flatnonzero(~((reach.low <= increments) & (increments <= reach.high)))  # NaN does not fit either
        if out.size:
            row = int(out[0])
            found.append(OutOfRange(row, name, reach.describe_fault(float(position_mm[name][row]))))
    return min(found, default=None)
