"""Backlash: how far the motor turns before the table follows, in micrometres at the table.

While the table stands still, the integral of the motor's speed is the dead band that is being crossed. It is measured
from standstill up to the row in which the table surely moves, less what the table has moved by then; its standard
deviation is that of the integral, with the uncertainty of the speed's zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fdhil.identification.motion import noise_levels, resolution
from fdhil.identification.windows import carried, moving_range
from fdhil.records import Reason, Window

CHANCE_DEVIATIONS = 5.5
LEAST_UM = 20.0  # what a correction of some tens of um must not leave unexplained
LEAST_ROWS = 8
AFTER_S = 0.010  # the table follows by now, and the play it had is taken up
LONGEST_S = 0.060  # before the table moves: a longer integral gathers more noise than dead band


@dataclass(frozen=True, slots=True)
class DeadBand:
    """Dead band ``um`` at the table with its standard deviation ``std_um``."""

    um: float
    std_um: float

    @property
    def sure(self) -> bool:
        """Return whether it is beyond chance."""
        return abs(self.um) > CHANCE_DEVIATIONS * self.std_um

    def reason(self) -> Reason:
        """Return it as the reason of a refusal."""
        text = f"the motor turns {self.um:.0f} ± {self.std_um:.0f} um before the table follows (backlash)"
        return Reason("ValidationFailed", text, "check screw, nut, coupling and bearings for play")


def dead_band(window: Window) -> DeadBand | None:
    """Return what the motor turns before the table follows; None where position or standstill are not recorded."""
    position, speed = carried(window.position_mm), carried(window.speed_rad_s)
    begin, end = moving_range(window)
    quantum = resolution(position)
    if window.stages.accelerate is None or quantum == 0.0 or begin < LEAST_ROWS:
        return None
    # the table moves for sure from this row on
    limit = 3 * quantum + 1e-3
    moves = np.flatnonzero(np.abs(position[:end] - position[0]) > limit)
    if moves.size == 0:
        return None
    to_um = 1e3 * window.pitch_mm / (2 * math.pi) * window.direction
    first = int(moves[0])
    start = max(LEAST_ROWS, first - round(LONGEST_S / window.dt_s))
    stop = min(first + round(AFTER_S / window.dt_s), end, position.size - 1)
    if not np.isfinite(window.speed_rad_s[:stop]).all() or start >= stop:
        return None
    # the axis may still settle from its last move: that is no offset of the speed
    crept = float(position[start] - position[0]) / (start * window.dt_s) / (to_um * 1e-3 * window.direction)
    zero = float(speed[:start].mean()) - crept
    turned = float(((speed[start:stop] + speed[start + 1 : stop + 1]) / 2 - zero).sum()) * window.dt_s * to_um
    moved = 1e3 * window.direction * float(position[stop] - position[start])
    rows = stop - start
    noise = noise_levels(window).speed_rad_s * window.dt_s * abs(to_um)
    std = math.hypot(noise * math.sqrt(rows + rows**2 / start), 1e3 * quantum / math.sqrt(6))
    return DeadBand(turned - moved, std)


def backlash(window: Window) -> DeadBand | None:
    """Return the dead band where it is beyond chance and larger than what a correction may leave open."""
    found = dead_band(window)
    return found if found is not None and found.sure and found.um > LEAST_UM else None
