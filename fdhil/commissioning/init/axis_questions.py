"""Questions about an axis in their order: where to find the answer, and the proposal if it can be guessed.

The meaning of a key is its description in ``fdhil/config``; here is only where to find it. A proposal is calculated
from the known keys of [axis.X].
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

Known = Mapping[str, Any]
Guess = Callable[[Known], Any]
"""Proposes a value from the known ones; KeyError if too little is known."""

FRICTION_SHARE = 0.05
CURRENT_LOOP_HZ, SPEED_LOOP_HZ, SPEED_CORNER_HZ = 400.0, 40.0, 8.0
USUAL_KV = 50.0
_PEAK = 2.0


@dataclass(frozen=True, slots=True)
class Question:
    """A key of [axis.X], ``where`` to find its value, a ``guess``, and ``how`` the guess is made.

    ``follows``: the guess is always possible once the others are known, so that the key itself is never missing.
    """

    key: str
    where: str
    guess: Guess | None = None
    how: str = ""
    follows: bool = True


def _estimate_torque_nm(known: Known) -> float:
    """The continuous torque as far as it is known; half the peak torque otherwise."""
    current = known.get("drive.rated_current_a") or known["regulators.current_limit_a"] / _PEAK
    return float(known["nominal.K"] * current)


def _compute_rapid_rad_s(known: Known) -> float:
    return float(known["rapid_speed_mm_s"] / known["screw_pitch_mm"] * 2 * math.pi)


DRIVE_TOOL = "the drive's own tool shows it; if unknown accept the proposal: fdhil reports later whether it fits"
SHEET = "the motor's data sheet"
PITCH = Question(
    "screw_pitch_mm", "the screw's label or drawing; with a gear: the travel of the table per motor revolution"
)
QUESTIONS = (
    Question("drive.increments_per_rev", "the drive's tool: position increments per motor revolution"),
    Question("radius_mm", "the radius of the largest part on the table: there an angle is converted to path error"),
    Question("rapid_speed_mm_s", "the NC's parameter for rapids; 1 m/min is 16.67 mm/s"),
    Question("max_acceleration_mm_s2", "the NC's parameter for the axis; 1 m/s2 is 1000 mm/s2"),
    Question("drive.rated_current_a", "the drive's tool or object 0x6075; often the motor's continuous current"),
    Question("drive.rated_torque_nm", "the drive's tool or object 0x6076; often the motor's continuous torque"),
    Question("drive.dc_link_v", "the drive's display, or a meter at its DC link"),
    Question("nominal.R", f"{SHEET}, at 20 degC; for three phases that of one phase, half of terminal to terminal"),
    Question("nominal.L", f"{SHEET}, in henry: 5 mH is 0.005; for three phases that of one phase"),
    Question("nominal.K", f"{SHEET}: torque per ampere of the drive's current"),
    Question(
        "nominal.Jt",
        f"the rotor's ({SHEET}) plus the screw's plus the table's mass in kg times (pitch in m / 6.283) squared",
    ),
    Question(
        "regulators.current_limit_a",
        f"the largest current; {DRIVE_TOOL}",
        lambda known: _PEAK * known["drive.rated_current_a"],
        "twice the rated current",
        follows=False,
    ),
    Question(
        "regulators.voltage_limit_v",
        "the DC link's voltage: the drive's display, or the mains' voltage times 1.41 behind a rectifier",
        lambda known: known["drive.dc_link_v"],
        "the DC link's voltage",
        follows=False,
    ),
    Question(
        "nominal.ft",
        "accept the proposal: the first rapids identify it",
        lambda known: FRICTION_SHARE * _estimate_torque_nm(known) / _compute_rapid_rad_s(known),
        "5 % of the continuous torque in a rapid; the first rapids identify it",
    ),
    Question(
        "nominal.Cd",
        "accept the proposal: the first rapids identify it",
        lambda known: FRICTION_SHARE * _estimate_torque_nm(known),
        "5 % of the continuous torque; the first rapids identify it",
    ),
    Question("regulators.position_gain_per_s", f"Kv; {DRIVE_TOOL}", lambda _known: USUAL_KV, "a usual value"),
    Question("regulators.speed_feedforward", f"1 is full; {DRIVE_TOOL}", lambda _known: 1.0, "full, as is usual"),
    Question(
        "regulators.speed_kp",
        DRIVE_TOOL,
        lambda known: 2 * math.pi * SPEED_LOOP_HZ * known["nominal.Jt"] / known["nominal.K"],
        f"a speed loop of {SPEED_LOOP_HZ:g} Hz for this inertia",
    ),
    Question(
        "regulators.speed_ki",
        DRIVE_TOOL,
        lambda known: 2 * math.pi * SPEED_CORNER_HZ * known["regulators.speed_kp"],
        f"its integral part from {SPEED_CORNER_HZ:g} Hz down",
    ),
    Question(
        "regulators.current_kp",
        DRIVE_TOOL,
        lambda known: 2 * math.pi * CURRENT_LOOP_HZ * known["nominal.L"],
        f"a current loop of {CURRENT_LOOP_HZ:g} Hz for this winding",
    ),
    Question(
        "regulators.current_ki",
        DRIVE_TOOL,
        lambda known: 2 * math.pi * CURRENT_LOOP_HZ * known["nominal.R"],
        f"a current loop of {CURRENT_LOOP_HZ:g} Hz for this winding",
    ),
)
