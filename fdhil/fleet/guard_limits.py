"""The numbers that the guard holds what it sends to, as a configuration makes them: a larger one lets more through.

Most keys act on them by a way of their own, as the torque constant does on the torque of the feed-forward.
"""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from fdhil.arming.guard_settings import settings_of
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError


def guard_limits(machine: MachineConfig) -> Mapping[str, float]:
    """Return all limits of the corrected axes, by words; none where no guard could be started with it."""
    found: dict[str, float] = {}
    try:
        settings = settings_of(machine, next(iter(machine.bus)), Path(), "")
    except ConfigError:
        return found
    for axis in settings.axes:
        told = {f"the offset's {name}": value for name, value in asdict(axis.limits).items() if name != "window"}
        if axis.feedforward is not None:
            told |= {f"the feed-forward's {name}": value for name, value in axis.feedforward.limits._asdict().items()}
        told |= {
            "the speed that is plausible": axis.max_speed_mm_s,
            "the acceleration that is plausible": axis.max_acceleration_mm_s2,
            "the change of speed that is plausible": axis.speed_step,
        }
        found |= {f"axis {axis.name}, {name}": float(value) for name, value in told.items()}
    return found
