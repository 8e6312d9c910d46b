"""Learns an offset from each pass of a program: the next pass is corrected by the repeating error that no model has.

Iterative learning control [Bristow, Tharayil, Alleyne 2006]: u' = Q (u + g L e), with e the error that the drive's own
encoder measured on the SYNC grid, L the zero-phase inverse of the identified loop, and Q a zero-phase low-pass above
which no model of a drive is reliable. The learned offset stays a small share of the allowed one. After a pass that is
worse than the one before, the gain is reduced; a pass worse than the first discards the learned offset. Errors that the
motor's encoder does not see, the screw's wind-up and its pitch, are not learned.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fdhil.config import MachineConfig
from fdhil.correction import linear_loop
from fdhil.correction.mirror import get_allowed_um
from fdhil.records import Float, Parameters, Trajectory

CORNER_HZ = 60.0  # of Q
GAIN = 0.7  # g: two passes remove nine tenths of the repeating error, and the noise of one has little effect
KEPT = 0.98  # of the learned offset, from pass to pass: unconfirmed parts fade
MOST_SHARE = 0.2  # of the largest offset that an axis may have
WORSE = 1.1  # times the pass before: good passes differ by less
CAUTION, TRUST = 0.5, 1.25  # factors on the gain after a pass that was worse, and after one that was not
PADDING_S = 0.25


@dataclass(frozen=True, slots=True)
class LearnedOffset:
    """The learned offset of one program: ``offset_um`` (n,) per axis is added to the plan's in the next pass.

    ``gain`` is the weight of the next error. ``curve_um`` is the RMS contour error that each pass so far measured,
    ``without_um`` that of the last pass without a learned offset.
    """

    offset_um: Mapping[str, Float]
    without_um: float = 0.0
    gain: float = GAIN
    curve_um: tuple[float, ...] = ()

    @staticmethod
    def make_empty(reference: Trajectory) -> LearnedOffset:
        """Return the zero offset of a program without passes."""
        return LearnedOffset(dict.fromkeys(reference.axes, np.zeros(reference.time_s.size)))


def learn_from_pass(
    offsets: LearnedOffset,
    error_um: Mapping[str, Float],
    rms_um: float,
    models: Mapping[str, Parameters],
    config: MachineConfig,
) -> LearnedOffset:
    """Return the learned offset after a complete, undisturbed pass with ``lesson.offset_um`` active.

    ``error_um`` (n,) per axis is target less measured position in each row of the program, ``rms_um`` the RMS of the
    pass' contour error. A pass worse than the last one without a learned offset discards it.
    """
    curve = (*offsets.curve_um, rms_um)
    learned = any(np.any(offset) for offset in offsets.offset_um.values())
    without_um = offsets.without_um if learned else rms_um
    if rms_um > WORSE * without_um:
        forgotten = {axis: np.zeros_like(u) for axis, u in offsets.offset_um.items()}
        return LearnedOffset(forgotten, rms_um, CAUTION * offsets.gain, curve)
    worse = len(curve) > 1 and rms_um > WORSE * curve[-2]
    gain = CAUTION * offsets.gain if worse else min(GAIN, TRUST * offsets.gain)
    period_s = config.machine.sync_period_s
    taught = {}
    for axis, error in error_um.items():
        inverse = linear_loop.invert_loop(models[axis], config.axis[axis], period_s, error.size)
        wanted = _filter_low_pass(KEPT * offsets.offset_um[axis] + gain * inverse.compute_offset(error), period_s)
        bound = MOST_SHARE * get_allowed_um(config, axis)
        taught[axis] = np.clip(wanted, -bound, bound)
    return LearnedOffset(taught, without_um, gain, curve)


def _filter_low_pass(values: Float, period_s: float) -> Float:
    """Return the values (n,) low-pass filtered without delay, and at rest at both ends."""
    from scipy.signal import butter, sosfiltfilt  # takes a third of a second to import

    sections = butter(2, min(CORNER_HZ, 0.2 / period_s), fs=1 / period_s, output="sos")
    pad = round(PADDING_S / period_s)
    smooth: Float = sosfiltfilt(sections, np.pad(values, pad), padtype=None)[pad:-pad]
    ends = np.clip(np.minimum(np.arange(values.size), np.arange(values.size)[::-1]) / (pad / 5), 0.0, 1.0)
    return np.asarray(smooth * ends)
