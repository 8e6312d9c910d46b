"""The feed that the drives can hold: what a path demands of current and voltage, against their limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fdhil.config import Axis, MachineConfig
from fdhil.model import closed_loop
from fdhil.prediction import inverse_dynamics as load
from fdhil.records import Float, Parameters, Trajectory

_HALVINGS = 9
_STEADY_S = 0.02  # a limit that acts shorter than this in all costs no more than a settling


@dataclass(frozen=True, slots=True)
class Load:
    """What the reference demands of a drive, as shares of its limits: by inverse dynamics, and where (row)."""

    current_share: float
    voltage_share: float
    row: int


def required(reference_mm: Float, parameters: Parameters, axis: Axis, dt_s: float) -> Load:
    """Return the largest current and voltage that ``reference_mm`` (n,) demands."""
    currents, voltages = load.required(reference_mm, parameters, axis, dt_s)
    row = int(np.argmax(np.maximum(currents, voltages)))
    return Load(float(currents.max()), float(voltages.max()), row)


def held_share(reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig) -> float:
    """Return the largest share <= 1 of the feed at which no limit of any drive acts for long, to 1 %.

    At a share s of the feed an NC with fixed smoothing times orders s times the speed and acceleration, so the path
    scaled by s shows the demand on the drives, dry friction included.
    """

    def holds(share: float) -> bool:
        for axis in reference.axes:
            path = reference.position_mm[axis]
            if np.ptp(path) == 0.0:
                continue
            scaled = path[0] + share * (path - path[0])
            demand = required(scaled, models[axis], config.axis[axis], reference.dt_s)
            if max(demand.current_share, demand.voltage_share) > 1.0:
                return False
            response = closed_loop.simulate(models[axis], config.axis[axis], reference.dt_s, scaled)
            if response.limited_s > 0.0:
                return False
        return True

    if holds(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def steadily_limited(limited_s: Mapping[str, float]) -> list[str]:
    """Return the axes on which a limit acts for longer than a settling."""
    return [axis for axis, seconds in limited_s.items() if seconds > _STEADY_S]
