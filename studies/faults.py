"""Every kind of the fault matrix that data can have, and the classes that name it rightly.

Each fault is drawn with a random severity, whose smallest value is part of what the study claims.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from studies import machine_faults, signal_faults
from studies.drives import Rng
from studies.machine_faults import of_demand, of_machine
from studies.scenes import FaultyRecording, make_good_recording
from studies.signal_faults import of_signals

__all__ = ["BETWEEN", "KINDS", "FaultyRecording", "Kind", "make_good_recording"]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault: how a bad recording is made, the codes that name it rightly, the severity's unit."""

    make: Callable[[Rng], FaultyRecording]
    named: frozenset[str]
    unit: str
    matrix: str


def _kind(make: Callable[[Rng], FaultyRecording], named: str, unit: str, matrix: str) -> Kind:
    return Kind(make, frozenset(named.split()), unit, matrix)


KINDS: Mapping[str, Kind] = {
    "sensor clipped": _kind(of_signals(signal_faults.clipped), "Saturated", "of the peak", "C1"),
    "not finite": _kind(of_signals(signal_faults.not_finite), "NotFinite", "samples", "C2"),
    "late trigger": _kind(of_signals(signal_faults.late_trigger), "MissingStage(accel)", "of the ramp", "C4"),
    "ends early": _kind(of_signals(signal_faults.ends_early), "MissingStage(brake)", "of the cruise", "C4"),
    "no plateau": _kind(of_demand(machine_faults.no_plateau), "MissingStage(cruise) NoWindow", "of the speed", "C5"),
    "cutting load": _kind(of_machine(machine_faults.cutting_load), "LoadDetected", "of the peak torque", "C6"),
    "stiff travel": _kind(of_machine(machine_faults.stiff_travel), "LoadDetected", "of the peak torque", "C6"),
    "collision": _kind(of_machine(machine_faults.collision), "LoadDetected", "of the peak torque", "C6"),
    "override changed": _kind(of_demand(machine_faults.override_changed), "EpisodeAborted", "of the speed", "C7"),
    "feed hold": _kind(of_demand(machine_faults.hold_resumed), "EpisodeAborted", "of the speed", "C7"),
    "quick stop": _kind(of_demand(machine_faults.quick_stop), "EpisodeAborted", "times as hard", "C7"),
    "left behind": _kind(machine_faults.left_behind, "EpisodeAborted", "of the travel", "C7"),
    "gain step": _kind(of_signals(signal_faults.gain_step), "CalibrationSuspect", "of the gain", "C8"),
    "gain drift": _kind(of_signals(signal_faults.gain_drift), "CalibrationSuspect", "of the gain", "C8"),
    "offset": _kind(of_signals(signal_faults.offset), "CalibrationSuspect", "of the peak", "C8"),
    "offset drift": _kind(of_signals(signal_faults.offset_drift), "CalibrationSuspect", "of the peak", "C8"),
    "speed scale": _kind(of_signals(signal_faults.speed_scale), "CalibrationSuspect", "of the scale", "C8"),
    "gain between rapids": _kind(machine_faults.gain_between, "CalibrationSuspect", "of the gain", "C8"),
    "constant speed": _kind(of_signals(signal_faults.constant_speed), "MissingStage(accel) RankDeficient", "", "D1"),
    "wrong sign": _kind(of_signals(signal_faults.wrong_sign), "Unphysical CalibrationSuspect", "", "D3"),
    "swapped columns": _kind(
        of_signals(signal_faults.swapped_columns),
        "Unphysical CalibrationSuspect Implausible NoWindow",
        "",
        "D3",
    ),
    "parameter moved": _kind(machine_faults.moved, "ParameterJump LoadChanged", "of the value", "D4"),
    "Stribeck friction": _kind(of_machine(machine_faults.stribeck), "ValidationFailed", "of the peak torque", "D5"),
    "backlash": _kind(of_machine(machine_faults.backlash), "ValidationFailed", "um", "D5"),
    "frames lost": _kind(of_signals(signal_faults.frames_lost), "Implausible", "s", "A10"),
    "counted gap": _kind(of_signals(signal_faults.counted_gap), "StaleData", "samples", "A10"),
    "stuck value": _kind(of_signals(signal_faults.stuck), "StuckValue", "s", "B11"),
    "voltage late": _kind(of_signals(signal_faults.voltage_late), "SampleTiming", "samples", "B12"),
    "current late": _kind(of_signals(signal_faults.current_late), "SampleTiming", "samples", "B12"),
    "lagging sensor": _kind(
        of_signals(signal_faults.lagging_sensor), "SampleTiming ValidationFailed", "samples", "B12"
    ),
}
BETWEEN = ("gain between rapids", "parameter moved")  # two good rapids that contradict each other
