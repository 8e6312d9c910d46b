"""Corners: the speed of the path from one piece to the next, and its rounding within the tolerance of G64 P.

A blend fades the piece before it out while the one after it grows: over 2 d of path around the corner, at u from 0 to
1, the point is p1(end - 2 d F(u)) + p2(2 d G(u)) - corner, where F is the integral of 1 - sigma from u to 1 and G that
of sigma from 0 to u. With sigma = u this is the parabola of constant acceleration; with sigma = 3 u2 - 2 u3
acceleration begins and ends at zero. The length of the path, and the path outside the blends, are unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdhil.program.planner.axis_limits import AxisLimits
from fdhil.program.planner.path_pieces import (
    ACCELERATION,
    BLENDS,
    JERK,
    LENGTH,
    SPEED,
    TOLERANCE,
    compute_curvature,
    compute_directions,
)
from fdhil.records import Float

ARC_SHARE = 0.866  # of the acceleration used for turning; half remains along the path, as in LinuxCNC's planner
_BLEND_SHARE = 0.9  # of the acceleration that a corner may use; the rest is for motion along the path
_JERK_SHARE = 0.5  # of the jerk that turning may use
_UNLIMITED = 1e12


@dataclass(frozen=True, slots=True)
class CornerLimits:
    """Per corner (m,): half the blend's length ``half`` mm (0: none), speed, and acceleration along the path."""

    half: Float
    speed: Float
    acceleration: Float


@dataclass(frozen=True, slots=True)
class _TurnDemand:
    """A corner's demand on the axes at unit speed, as a share of their limits (m,): from its kink and its curvature."""

    kink: Float
    kink_by_acceleration: Float
    kink_by_jerk: Float
    bend: Float
    curve_by_acceleration: Float
    bend_by_acceleration: Float
    bend_by_jerk: Float
    spin_by_jerk: Float
    jump_by_jerk: Float
    along_by_acceleration: Float
    along_by_jerk: Float


class CornerRules:
    """The rules of one machine; ``filter_s`` is the length of the jerk-limiting average, 0 for trapezoidal."""

    def __init__(self, limits: AxisLimits, filter_s: float) -> None:
        self._acceleration = np.minimum(np.array(limits.acceleration), _UNLIMITED)
        self._jerk = np.minimum(np.array(limits.jerk), _UNLIMITED)
        self._dt_s = limits.dt_s
        self._filter_s = filter_s

    def limit_pieces(self, pieces: Float) -> tuple[Float, Float]:
        """Return speed and acceleration (n,) along pieces of path, reduced on arcs."""
        speed, acceleration = pieces[:, SPEED], pieces[:, ACCELERATION]
        curvature = np.maximum(compute_curvature(pieces), 1e-12)
        speed = np.minimum(speed, np.sqrt(ARC_SHARE * acceleration / curvature))
        along = acceleration * np.sqrt(1.0 - np.minimum(speed**2 * curvature / acceleration, ARC_SHARE) ** 2)
        if self._filter_s:
            jerk = pieces[:, JERK]
            speed = np.minimum(speed, np.cbrt(_JERK_SHARE * jerk / curvature**2))
            turning = compute_curvature(pieces) > 0.0
            shared = _JERK_SHARE * jerk / (2.0 / self._filter_s + 3.0 * speed * curvature)
            along = np.where(turning, np.minimum(along, shared), along)
        return speed, along

    def limit_corners(self, pieces: Float) -> CornerLimits:
        """Return the corners between each piece and the next, (n - 1,)."""
        turn = self._assess_turn(pieces)
        free, _ = self.limit_pieces(pieces)
        wanted = np.minimum(free[:-1], free[1:])
        sharp = self._compute_sharp_speed(turn)
        room = np.minimum(pieces[:-1, LENGTH], pieces[1:, LENGTH]) / 2.0
        room = np.minimum(room, self._compute_half_within_tolerance(turn, pieces[:-1, TOLERANCE]))
        blend = (pieces[:-1, BLENDS] > 0.0) & (sharp < wanted) & (room > 0.0)
        half = np.where(blend, np.minimum(room, self._compute_half_for_speed(turn, wanted)), 1.0)
        speed = np.minimum(wanted, self._compute_blend_speed(turn, half))
        blend &= speed > sharp
        through = np.minimum(wanted, sharp)
        return CornerLimits(
            np.where(blend, half, 0.0),
            np.where(blend, speed, through),
            np.where(
                blend,
                self._compute_blend_acceleration(turn, half, speed),
                self._compute_sharp_acceleration(turn, through),
            ),
        )

    def _assess_turn(self, pieces: Float) -> _TurnDemand:
        tangent_out, curvature_out = compute_directions(pieces[:-1], at_end=True)
        tangent_in, curvature_in = compute_directions(pieces[1:], at_end=False)
        kink = np.abs(tangent_in - tangent_out)
        jump = np.abs(curvature_in - curvature_out)
        bend_out, bend_in = np.linalg.norm(curvature_out, axis=1), np.linalg.norm(curvature_in, axis=1)
        along = np.maximum(np.abs(tangent_out), np.abs(tangent_in))
        before, after = pieces[:-1], pieces[1:]
        jerk = np.minimum(before[:, JERK], after[:, JERK])
        acceleration = np.minimum(before[:, ACCELERATION], after[:, ACCELERATION])
        # an arc also turns within the blend, by half its length at most, which adds to the kink
        curve = np.maximum(bend_out, bend_in)
        bend = curve + self._peak_slope * (bend_out + bend_in) / 2.0
        return _TurnDemand(
            kink=np.linalg.norm(kink[:, :3], axis=1),
            kink_by_acceleration=np.max(kink / self._acceleration, axis=1) + 1e-15,
            kink_by_jerk=np.max(kink / self._jerk, axis=1) + 1e-18,
            bend=bend_out + bend_in,
            curve_by_acceleration=curve / acceleration,
            bend_by_acceleration=bend / acceleration,
            bend_by_jerk=(bend_out + bend_in) / jerk,
            spin_by_jerk=curve**2 / jerk,
            jump_by_jerk=np.max(jump / self._jerk, axis=1) + 1e-18,
            along_by_acceleration=np.max(along / self._acceleration, axis=1),
            along_by_jerk=np.max(along / self._jerk, axis=1),
        )

    def _compute_sharp_speed(self, turn: _TurnDemand) -> Float:
        """Return the speed at which a corner needs no rounding: its step is within the limits of one period."""
        if not self._filter_s:
            step = turn.kink_by_acceleration / self._dt_s
            root = np.sqrt(step**2 + 4.0 * _BLEND_SHARE * turn.curve_by_acceleration)
            return np.asarray(2.0 * _BLEND_SHARE / (step + root))
        step = self._dt_s**2 / turn.kink_by_jerk
        return np.minimum(step, np.sqrt(self._dt_s / turn.jump_by_jerk))

    def _compute_sharp_acceleration(self, turn: _TurnDemand, speed: Float) -> Float:
        if self._filter_s:
            return np.full(speed.size, _UNLIMITED)
        used = speed * turn.kink_by_acceleration / self._dt_s + speed**2 * turn.curve_by_acceleration
        return np.asarray(np.maximum(1.0 - used, 1.0 - _BLEND_SHARE) / turn.along_by_acceleration)

    def _compute_half_within_tolerance(self, turn: _TurnDemand, tolerance_mm: Float) -> Float:
        """Return the largest half length within the tolerance: d kink (1/4 or 3/16) + d2 curvature / 16 at most."""
        tolerance = np.minimum(tolerance_mm, _UNLIMITED)
        linear = turn.kink * (0.1875 if self._filter_s else 0.25)
        root = np.sqrt(linear**2 + turn.bend * tolerance / 4.0)
        return np.asarray(2.0 * tolerance / np.maximum(linear + root, 1e-12))

    def _compute_half_for_speed(self, turn: _TurnDemand, speed: Float) -> Float:
        spared = np.maximum(_BLEND_SHARE - speed**2 * turn.bend_by_acceleration, _BLEND_SHARE / 2.0)
        half = self._peak_slope * speed**2 * turn.kink_by_acceleration / (2.0 * spared)
        if not self._filter_s:
            return np.asarray(half)
        budget = _JERK_SHARE / speed**3
        budget = np.maximum(budget - turn.spin_by_jerk, budget / 2.0)
        root = np.sqrt(turn.bend_by_jerk**2 + 6.0 * turn.kink_by_jerk * budget)
        return np.maximum(half, (turn.bend_by_jerk + root) / (2.0 * budget))

    def _compute_blend_speed(self, turn: _TurnDemand, half: Float) -> Float:
        turning = self._peak_slope * turn.kink_by_acceleration / (2.0 * half) + turn.bend_by_acceleration
        speed = np.sqrt(_BLEND_SHARE / turning)
        if self._filter_s:
            jerk = 1.5 * turn.kink_by_jerk / half**2 + turn.bend_by_jerk / half + turn.spin_by_jerk
            speed = np.minimum(speed, np.cbrt(_JERK_SHARE / jerk))
        return np.asarray(speed)

    def _compute_blend_acceleration(self, turn: _TurnDemand, half: Float, speed: Float) -> Float:
        bend = self._peak_slope * turn.kink_by_acceleration / (2.0 * half) + turn.bend_by_acceleration
        along = np.maximum(1.0 - speed**2 * bend, 1.0 - _BLEND_SHARE) / turn.along_by_acceleration
        if self._filter_s:
            bend_by_jerk = self._peak_slope * turn.kink_by_jerk / (2.0 * half) + turn.bend_by_jerk
            per_unit = 2.0 / self._filter_s * turn.along_by_jerk + 3.0 * speed * bend_by_jerk
            along = np.minimum(along, _JERK_SHARE / per_unit)
        return np.asarray(along)

    @property
    def _peak_slope(self) -> float:
        """Largest slope of sigma."""
        return 1.5 if self._filter_s else 1.0


def compute_fade(u: Float, smooth: bool) -> tuple[Float, Float]:
    """Return F(u) and G(u) (n,) of a blend at u in [0, 1]."""
    if not smooth:
        return (1.0 - u) ** 2 / 2.0, u**2 / 2.0
    grown = u**3 - u**4 / 2.0
    return 0.5 - u + grown, grown
