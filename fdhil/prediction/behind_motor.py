"""Computes how far each table leads its motor along a path, if its model has a resonance."""

from __future__ import annotations

from collections.abc import Mapping

from fdhil.config import MachineConfig
from fdhil.model import closed_loop
from fdhil.records import Float, Parameters


def ahead_of_motor_mm(
    position_mm: Mapping[str, Float],
    offset_um: Mapping[str, Float],
    models: Mapping[str, Parameters],
    config: MachineConfig,
) -> dict[str, Float]:
    """Return table less motor (n,) in mm of each axis with a resonance: the part that its encoder does not see.

    The axes follow ``position_mm`` (n,) with ``offset_um`` (n,).
    """
    period_s = config.machine.sync_period_s
    found = {}
    for axis, path_mm in position_mm.items():
        if models[axis].term("resonance"):
            offset_mm = offset_um[axis] * 1e-3
            response = closed_loop.simulate(models[axis], config.axis[axis], period_s, path_mm, offset_mm)
            found[axis] = response.table_mm - response.position_mm
    return found
