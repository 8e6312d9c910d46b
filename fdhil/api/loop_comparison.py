"""Compares a drive's identified loops with the configured ones, and lists equivalent controllers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from fdhil.api.recording_analysis import FileResult
from fdhil.config import Axis, Identification, MachineConfig, Regulators
from fdhil.daemon import build_loops_document
from fdhil.pipeline import identify_from_outcomes
from fdhil.records import LoopEstimate

ALL_FED = 0.01  # tolerance of a feed-forward share of 1
LOOP_UNITS: Mapping[str, str] = {
    "position_gain_per_s": "1/s",
    "speed_feedforward": "1",
    "speed_kp": "A.s/rad",
    "speed_ki": "A/rad",
    "position_ki_per_s2": "1/s2",
    "torque_feedforward": "1",
    "speed_filter_s": "s",
    "setpoint_filter_s": "s",
    "current_delay_cycles": "1",
}


def identify_all_loops(
    results: Sequence[FileResult], settings: Identification, machine: MachineConfig | None
) -> list[FileResult]:
    """Return the results with the loops of each recording, even where none were required."""
    axes = {} if machine is None else machine.axis
    period_s = None if machine is None else machine.machine.sync_period_s
    return [
        r
        if r.loops
        else replace(r, loops=identify_from_outcomes(r.outcomes, axes.get(r.axis or ""), settings, period_s))
        for r in results
    ]


def compare_loops(found: LoopEstimate | None, axis: Axis | None) -> dict[str, Any] | None:
    """Return the loops with the configured ones, for JSON; None where the recording has none."""
    if found is None:
        return None
    regulators = None if axis is None else axis.regulators
    document = build_loops_document(found)
    gains = document["gains"].items()
    return {
        "structure": found.structure,
        "configured_structure": None if regulators is None else regulators.structure,
        "same_as": [dict(each) for each in list_equivalent_loops(found)],
        "gains": {
            n: {**gain, "unit": LOOP_UNITS[n], "configured": get_configured_value(regulators, n)} for n, gain in gains
        },
        **{key: document[key] for key in ("validated", "unexplained_um", "configured_um", "reasons", "warnings")},
    }


def list_equivalent_loops(found: LoopEstimate) -> list[Mapping[str, float | str]]:
    """Return the other sets of gains of the same controller; speed_kp and the rest are unchanged.

    With full speed feed-forward, a cascade of position gain a and speed_ki = b speed_kp and a PID of position gain a +
    b and position_ki = a b demand the same current, and so does the cascade with a and b exchanged. (The PID derives
    that speed from its own set-points, half a SYNC cycle later.)
    """
    gains = dict(zip(found.names, found.values.tolist(), strict=True))
    kp, fed = gains.get("speed_kp"), gains.get("speed_feedforward", 1.0)
    if kp is None or "position_gain_per_s" not in gains or abs(fed - 1.0) > ALL_FED:
        return []
    first = gains["position_gain_per_s"]
    if found.structure == "p_pi_pi" and "speed_ki" in gains:
        a, b = first, gains["speed_ki"] / kp
        pid = {"structure": "pid", "position_gain_per_s": a + b, "position_ki_per_s2": a * b}
        return [pid, {"structure": "p_pi_pi", "position_gain_per_s": b, "speed_ki": a * kp}]
    if found.structure == "pid" and (square := first**2 / 4 - gains.get("position_ki_per_s2", 0.0)) >= 0.0:
        roots = first / 2 - math.sqrt(square), first / 2 + math.sqrt(square)
        pairs = (roots, roots[::-1])
        return [{"structure": "p_pi_pi", "position_gain_per_s": a, "speed_ki": b * kp} for a, b in pairs if a > 0.0]
    return []


def get_configured_value(regulators: Regulators | None, name: str) -> float | None:
    return None if regulators is None else float(getattr(regulators, name))
