"""Divides one budget of false alarms among all checks; every threshold of chance follows from it.

Significance alone refuses nothing where a window has a thousand rows: each check also requires that its finding is
large enough to matter, which is physics and stands with the check.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist

FALSE_ALARMS = 0.01  # of one good window, by all checks together, if every finding were large enough to matter


@dataclass(frozen=True, slots=True)
class Share:
    """The share of one check in the budget, divided among ``tests`` of the same kind."""

    share: float
    tests: int = 1

    @property
    def chance(self) -> float:
        """Probability of a false alarm of one test."""
        return FALSE_ALARMS * self.share / self.tests

    @property
    def log_chance(self) -> float:
        """Logarithm of that probability."""
        return math.log(self.chance)

    @property
    def deviations(self) -> float:
        """Standard deviations beyond which a normal number lies, on either side, by that chance."""
        return -NormalDist().inv_cdf(self.chance / 2)


BUDGET: Mapping[str, Share] = {
    "stuck": Share(0.6, 3),  # signals, each with all readings at which a run of repeats may begin: 2e-3 a signal
    "data sheet": Share(0.26),  # 3 deviations of one value: two must lie beyond them, and beyond the tolerance
    "structure": Share(0.068, 100),  # alternatives: 4.5 deviations each
    "saturated": Share(0.06, 6),  # extremes: 1e-4 each, shared by all readings
    "whiteness": Share(2.87e-3, 50),  # lags of two signals: 5 deviations
    "timing": Share(1.36e-3, 2),  # voltage and current: 4.5 deviations
    "slow voltage": Share(1e-3),  # 1e-5, shared by all its samples
    "position": Share(1e-3, 5000),  # rows, each over five lengths: 6 deviations
    "play": Share(6.8e-4),  # 4.5 deviations
    "cut off": Share(6e-4, 6),  # extremes: 1e-6, as the voltage's course within a row is least known there
    "between windows": Share(3.44e-4, 6),  # parameters: 5 deviations
    "standstill": Share(1.52e-5, 4),  # 5.5 deviations: the noise of standstill may not be that of the move
}
