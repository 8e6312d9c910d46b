"""Refuses corrections that are not predicted to help, and adds advice to every refusal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt, maximum_filter1d

from fdhil.config import MachineConfig, find_share_fault
from fdhil.prediction import compute_required_shares, find_feasible_feed_share
from fdhil.records import Bool, Float, Parameters, Prediction, Reason, Trajectory

STEADY_S = 0.02  # a limit that acts for less in total has no lasting effect
NEAR_SHARE = 0.95  # of a current or voltage limit: worth a warning
LEAST_GAIN = 1.05  # before / after RMS
NOTHING_UM = 0.05  # a smaller RMS needs no correction
WORSE_UM = 1.0  # allowed growth of a zone's largest error
HELD_OUT_SHARE = 0.43  # of the largest error in held-out moves: how much worse a position gets (studies.zoo: 0.39-0.48)
ZONE_S = 0.1  # closer errors belong to one zone
MASK_S, FADE_S = 0.04, 0.06  # uncorrected time around a row that gets worse, and duration of the fade


def check_writing_enabled(axes: Sequence[str], config: MachineConfig) -> tuple[Reason, ...]:
    """Refuse axes without limits (writing is off by default), and axes too slow for their increments."""
    found = [_check_axis_writable(axis, config) for axis in axes]
    return tuple(reason for reason in found if reason is not None)


def _check_axis_writable(axis: str, config: MachineConfig) -> Reason | None:
    if axis not in config.axis or config.axis[axis].correction is None:
        return Reason(
            "WritingOff",
            f"axis {axis} has no section [axis.{axis}.correction]: writing to its drive is off",
            f"add [axis.{axis}.correction] with max_offset_um, max_speed_mm_s and max_acceleration_mm_s2",
        )
    fault = find_share_fault(config.axis[axis], config.machine.sync_period_s)
    return (
        None if fault is None else Reason("CoarseIncrements", f"axis {axis}: {fault}", f"leave axis {axis} uncorrected")
    )


def check_drive_demand(
    reference: Trajectory, models: Mapping[str, Parameters], config: MachineConfig, before: Prediction
) -> tuple[tuple[Reason, ...], tuple[Reason, ...]]:
    """Return (refused, warnings): no offset helps a drive at its current or voltage limit."""
    refused, warnings = [], []
    for axis in reference.axes:
        asked = compute_required_shares(reference.position_mm[axis], models[axis], config.axis[axis], reference.dt_s)
        share, what = max(zip((float(one.max()) for one in asked), ("current", "voltage"), strict=True))
        peak = float(np.abs(before.current_a[axis]).max()) / config.axis[axis].regulators.current_limit_a
        place = reference.describe_position(int(np.argmax(np.maximum(*asked))))
        if share > 1.0 or before.limited_s[axis] > STEADY_S:
            refused.append((axis, share, what, place))
        elif share > NEAR_SHARE or peak > NEAR_SHARE or before.limited_s[axis] > 0.0:
            text = f"axis {axis} is near its {what} limit at {place}: little reserve remains for disturbances"
            warnings.append(Reason("NearLimit", text, "lower the feed if the path error matters there"))
    if not refused:
        return (), tuple(warnings)
    held = find_feasible_feed_share(reference, models, config)
    fastest = float(np.linalg.norm(np.diff(reference.path_mm, axis=0), axis=1).max()) / reference.dt_s * 0.06
    feed = f"{held * fastest:.1f} m/min ({held * 100:.0f} % of {fastest:.1f})"
    advice = f"lower the feed to {feed}, or increase the smoothing"
    return tuple(
        Reason(
            "DemandTooHigh",
            f"axis {axis} needs {share * 100:.0f} % of its {what} limit at {place} and is limited for"
            f" {before.limited_s[axis] * 1e3:.0f} ms: no offset can help",
            advice,
        )
        for axis, share, what, place in refused
    ), tuple(warnings)


def find_worse_rows(before_um: Float, after_um: Float, dt_s: float) -> Bool:
    """Return (n,) the rows of zones whose largest contour error the correction would raise by more than 1 um."""
    size = 2 * round(ZONE_S / dt_s) + 1
    then, now = maximum_filter1d(before_um, size), maximum_filter1d(after_um, size)
    return np.asarray((now > then + WORSE_UM) & (after_um > then + WORSE_UM))


def advise_against_harm(models: Mapping[str, Parameters]) -> str:
    """Return the advice where a correction would do harm."""
    swinging = {axis: model.get_term("resonance") for axis, model in models.items() if model.get_term("resonance")}
    if not swinging:
        return "try the method inverse, or lower the feed there"
    axes = ", ".join(f"{axis} at {hertz:.0f} Hz" for axis, hertz in swinging.items())
    advice = "lower the feed there, or increase the smoothing"
    return f"{advice}: the drive cannot compensate a table that oscillates behind its motor ({axes})"


def make_mask_factor(worse: Bool, dt_s: float) -> Float:
    """Return a factor (n,): 0 in and around the rows that get worse, 1 far from them, smooth in between."""
    if not worse.any():
        return np.ones(worse.size)
    ratio = np.clip((distance_transform_edt(~worse) * dt_s - MASK_S) / FADE_S, 0.0, 1.0)
    return np.asarray(ratio**3 * (10 - 15 * ratio + 6 * ratio**2))


def check_held_out_error(largest_um: float | None) -> tuple[Reason, ...]:
    """Refuse a model whose largest error in held-out moves, mostly at a late reversal, would affect good positions."""
    if largest_um is None or largest_um * HELD_OUT_SHARE <= WORSE_UM:
        return ()
    text = f"held-out moves were predicted to {largest_um:.1f} um only: a position that is good now may get worse by "
    text += f"{largest_um * HELD_OUT_SHARE:.1f} um, limit {WORSE_UM:g} um"
    advice = "look for play, reversal friction or a resonance that the model lacks, then identify again"
    return (Reason("HarmPredicted", text, advice),)


def check_gain(then_um: float, now_um: float) -> tuple[Reason, ...]:
    """Refuse a correction that is not predicted to reduce the RMS contour error."""
    if then_um < NOTHING_UM:
        return (Reason("NoGain", f"the path error is {then_um:.3f} um RMS already", "no correction is needed"),)
    if not now_um * LEAST_GAIN <= then_um:
        text = f"the path error would be {now_um:.1f} um RMS with the correction, {then_um:.1f} um without"
        return (Reason("NoGain", text, "try the method inverse, or lower the feed"),)
    return ()


def check_result(before: Prediction, after: Prediction, untouched: bool = False) -> tuple[Reason, ...]:
    """Refuse a correction that is not predicted to help, or (unless ``untouched``) that makes a zone worse."""
    none = check_gain(before.rms_um, after.rms_um)
    if none:
        return none
    worse = np.flatnonzero(find_worse_rows(before.contour_um, after.contour_um, before.reference.dt_s))
    if worse.size and not untouched:
        row = int(worse[np.argmax(after.contour_um[worse])])
        text = f"at {before.reference.time_s[row]:.3f} s the error would grow to {after.contour_um[row]:.1f} um"
        return (Reason("HarmPredicted", text, "try the method inverse, or lower the feed"),)
    return ()
