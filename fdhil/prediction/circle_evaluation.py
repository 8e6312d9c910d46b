"""Evaluates a circle run in both directions as ISO 230-4 does: circular deviation, hysteresis, radial deviation.

Pure. Deviations are radial, about the least-squares centre of both runs together, as for a ball bar, which cannot tell
where the programmed centre is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdhil.errors import RecordingError
from fdhil.records import Float, freeze_array

CIRCLE_POINTS = 720  # angles at which the runs are compared
NEAR = 0.2  # of the radius: rows farther from the circle are lead-in or lead-out
TURN = 2 * np.pi


@dataclass(frozen=True, slots=True)
class CircleDeviations:
    """Radial deviations (GRID,) um at equal angles from the first axis on, for each direction of the run."""

    radius_mm: float
    counter_um: Float
    clockwise_um: Float

    @property
    def deviations_um(self) -> tuple[float, float]:
        """G of the counter-clockwise and of the clockwise run: the distance between its two concentric circles.

        Their common centre is the least-squares centre of the run itself.
        """
        counter, clockwise = (np.ptp(_remove_centre_offset(run)) for run in (self.counter_um, self.clockwise_um))
        return float(counter), float(clockwise)

    @property
    def both_um(self) -> float:
        """G(b): the distance between two concentric circles around both runs."""
        return float(np.ptp(np.concatenate([self.counter_um, self.clockwise_um])))

    @property
    def hysteresis_um(self) -> float:
        """H: the largest radial difference between the runs at one angle."""
        return float(np.abs(self.counter_um - self.clockwise_um).max())

    @property
    def radial_um(self) -> tuple[float, float]:
        """F max and F min: the farthest from the programmed circle, outside (+) and inside (-)."""
        both = np.concatenate([self.counter_um, self.clockwise_um])
        return float(both.max()), float(both.min())


def evaluate_circle(path_mm: Float, radius_mm: float, centre_mm: tuple[float, float] | None = None) -> CircleDeviations:
    """Evaluate a path (n, 2) that runs the circle in both directions, each for 360 degrees or more.

    The middle 360 degrees of each run count, so that starting and stopping do not. The default centre is the middle of
    the path's extent. RecordingError without two such runs.
    """
    centre = (path_mm.min(axis=0) + path_mm.max(axis=0)) / 2 if centre_mm is None else np.asarray(centre_mm)
    away = path_mm - centre
    radius = np.hypot(*away.T)
    on = np.abs(radius - radius_mm) < NEAR * radius_mm
    if np.count_nonzero(on) < CIRCLE_POINTS // 8:
        raise RecordingError(f"the path contains no circle of {radius_mm:g} mm radius; check the radius")
    angle, deviation_um = np.unwrap(np.arctan2(away[on, 1], away[on, 0])), (radius[on] - radius_mm) * 1e3
    turned = angle - angle[0]
    split = int(np.argmax(np.abs(turned)))
    runs = {}
    for part in (slice(0, split + 1), slice(split, None)):
        there = angle[part]
        if abs(there[-1] - there[0]) < TURN - 1e-3:
            text = "the circle is not run through 360 degrees in both directions"
            raise RecordingError(f"{text}; run it with G2 and G3, each a little more than once around")
        runs[bool(there[-1] > there[0])] = _extract_middle_turn(there, deviation_um[part])
    both = _remove_centre_offset(np.concatenate([runs[True], runs[False]]))
    return CircleDeviations(radius_mm, freeze_array(both[:CIRCLE_POINTS]), freeze_array(both[CIRCLE_POINTS:]))


def _extract_middle_turn(angle: Float, deviation_um: Float) -> Float:
    inside = np.abs(angle - (angle[0] + angle[-1]) / 2) <= TURN / 2
    at = np.mod(angle[inside], TURN)
    order = np.argsort(at, kind="stable")
    found: Float = np.interp(
        np.arange(CIRCLE_POINTS) * TURN / CIRCLE_POINTS, at[order], deviation_um[inside][order], period=TURN
    )
    return found


def _remove_centre_offset(deviation_um: Float) -> Float:
    """Return deviations (GRID,) or (2 GRID,) about their least-squares centre, exact where it is micrometres away."""
    angle = np.arange(deviation_um.size) * TURN / CIRCLE_POINTS
    across, along = (2 * np.mean(deviation_um * wave) for wave in (np.cos(angle), np.sin(angle)))
    return np.asarray(deviation_um - across * np.cos(angle) - along * np.sin(angle))


def write_circle_program(axes: tuple[str, str], radius_mm: float, feed_mm_min: float) -> str:
    """Return an NC program that runs the circle twice around in each direction, around where it starts."""
    plane = {("X", "Y"): "G17", ("X", "Z"): "G18", ("Y", "Z"): "G19"}[axes]
    a, b = axes
    # seen along the normal axis, Z to X turns as G18 counts: there G2 and G3 change places
    turns = ("G3", "G2") if plane != "G18" else ("G2", "G3")
    towards = {"X": "I", "Y": "J", "Z": "K"}
    centre = f"{towards[a]}{-radius_mm:.6f} {towards[b]}0"
    arcs = [f"{turn} {a}{radius_mm:.6f} {b}0 {centre} P2 F{feed_mm_min:.6f}\nG4 P0.5" for turn in turns]
    return "\n".join(["G21 G90 G94 G91.1", plane, f"G0 {a}{radius_mm:.6f} {b}0", "G4 P0.5", *arcs, "M2", ""])
