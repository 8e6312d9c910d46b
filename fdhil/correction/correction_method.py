"""Defines the common interface of the correction methods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from fdhil.config import MachineConfig
from fdhil.records import Float, Parameters, Prediction, Reason, Trajectory


@dataclass(frozen=True, slots=True)
class MethodPlan:
    """A method's result: ``offset_um`` (n,) per axis, within the limits and in whole increments.

    ``measure_delay_s`` is the common delay tau that the method aims at, r(t - tau). ``refused`` are the method's own
    refusals.
    ``untouched``: the offset is sent unchanged, or not at all (mirror). The speed and torque offsets (0x60B1, 0x60B2)
    are empty except for an on-line feed-forward.
    """

    offset_um: Mapping[str, Float]
    delay_s: float = 0.0
    refused: tuple[Reason, ...] = ()
    untouched: bool = False
    speed_offset_rad_s: Mapping[str, Float] = field(default_factory=dict)
    torque_offset_nm: Mapping[str, Float] = field(default_factory=dict)


class CorrectionMethod(Protocol):
    """A correction method; ``before`` is the prediction without it."""

    def __call__(
        self, reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, before: Prediction, /
    ) -> MethodPlan: ...
