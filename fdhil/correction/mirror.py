"""Plans the mirror correction ([DES] eq. 11, H ~ 1, figure 16): the predicted error, its sign changed, unfiltered."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fdhil.config import Axis, MachineConfig
from fdhil.correction.correction_method import MethodPlan
from fdhil.correction.plan_limits import fit_all_axes
from fdhil.records import Parameters, Prediction, Reason, Trajectory

FULL = 0.95  # of the speed feed-forward: less leaves a lag


def plan_mirror_offsets(
    reference: Trajectory,
    models: Mapping[str, Parameters],
    config: MachineConfig,
    before: Prediction,
) -> MethodPlan:
    """Return offset = -error of the prediction ``before``, within the limits.

    Refused with ``LagTooLarge`` if the error exceeds the largest offset: a clipped mirror is not a mirror.
    """
    wanted = {axis: -error for axis, error in before.error_um.items()}
    largest = {axis: float(np.abs(offset).max(initial=0.0)) for axis, offset in wanted.items()}
    return MethodPlan(
        fit_all_axes(wanted, config.axis, reference.dt_s),
        refused=check_lag_limits(largest, models, config),
        untouched=True,
    )


def check_lag_limits(
    needed_um: Mapping[str, float], models: Mapping[str, Parameters], config: MachineConfig
) -> tuple[Reason, ...]:
    """Return the reason for each axis whose required offset exceeds its limit."""
    return tuple(
        build_lag_reason(axis, needed, get_allowed_um(config, axis), models[axis], config.axis[axis])
        for axis, needed in needed_um.items()
        if not needed <= get_allowed_um(config, axis)
    )


def get_allowed_um(config: MachineConfig, axis: str) -> float:
    """Return the largest allowed offset of an axis, 0 if writing is off."""
    limits = config.axis[axis].correction
    return limits.max_offset_um if limits is not None else 0.0


def build_lag_reason(name: str, needed_um: float, allowed_um: float, model: Parameters, axis: Axis) -> Reason:
    """Return the reason for an axis that lags, or a table that oscillates, by more than an offset may compensate."""
    feedforward, hertz = axis.regulators.speed_feedforward, model.get_term("resonance")
    needs = f"needs offsets of {needed_um:.0f} um, {allowed_um:.0f} um are allowed"
    if hertz and feedforward >= FULL:
        text = f"axis {name} {needs}: its table oscillates behind the motor at {hertz:.0f} Hz, beyond the drive's reach"
        return Reason("ResonanceBeyondReach", text, "lower the feed, or increase the smoothing")
    advice = (
        f"enable the drive's speed feed-forward (it is {feedforward:g}), then identify and plan again"
        if feedforward < FULL
        else f"lower the feed, or raise max_offset_um of axis {name} if the machine allows it"
    )
    return Reason("LagTooLarge", f"axis {name} {needs}", advice)
