"""Derives the guard's limits from a configuration; a larger limit lets larger offsets through.

Most configuration keys act on the limits indirectly, as the torque constant does on the feed-forward torque.
"""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from fdhil.arming import make_guard_settings
from fdhil.config import MachineConfig
from fdhil.errors import ConfigError


def derive_guard_limits(machine: MachineConfig) -> Mapping[str, float]:
    """Return all limits of the corrected axes, by description; none where no guard could start with it."""
    found: dict[str, float] = {}
    try:
        settings = make_guard_settings(machine, next(iter(machine.bus)), Path(), "")
    except ConfigError:
        return found
    for axis in settings.axes:
        limits = {f"the offset's {name}": value for name, value in asdict(axis.limits).items() if name != "window"}
        if axis.feedforward is not None:
            limits |= {f"the feed-forward's {name}": value for name, value in axis.feedforward.limits._asdict().items()}
        limits |= {
            "the highest plausible speed": axis.max_speed_mm_s,
            "the highest plausible acceleration": axis.max_acceleration_mm_s2,
            "the highest plausible change of speed": axis.speed_step,
        }
        found |= {f"axis {axis.name}, {name}": float(value) for name, value in limits.items()}
    return found
