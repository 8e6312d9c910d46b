"""The immutable records that cross rooms. Arrays are read-only float64 unless said; the unit is in the name.

Physics is SI (V, A, rad/s, N.m, kg.m2, s), path geometry is millimetres, path errors are micrometres where the
name says ``_um``. Drive increments appear in none of them.
"""

from __future__ import annotations

from fdhil.records.nc import NcState
from fdhil.records.paths import Correction, HeldOut, Prediction, Skill, Trajectory, Zone, table_path
from fdhil.records.signals import (
    AxisSamples,
    MoveEvent,
    MoveKind,
    NcMove,
    Recording,
    SlowVoltage,
    Stages,
    TableSamples,
    TableSignal,
    Temperature,
    TickTimes,
    VoltageSamples,
    VoltageSampling,
    Window,
)
from fdhil.records.values import (
    INTERVAL_95,
    PARAMETERS,
    RATIOS,
    UNITS,
    Bool,
    Float,
    Int,
    Parameters,
    frozen,
    frozen_ints,
    read_only,
    rms,
    unit_of,
)
from fdhil.records.verdicts import (
    AtTable,
    Estimate,
    LoopEstimate,
    Notice,
    ParameterSet,
    Reason,
    Result,
    Verdict,
    WindowOutcome,
)

Outcome = WindowOutcome | ParameterSet | Skill | Notice | LoopEstimate

__all__ = [
    "INTERVAL_95",
    "PARAMETERS",
    "RATIOS",
    "UNITS",
    "AtTable",
    "AxisSamples",
    "Bool",
    "Correction",
    "Estimate",
    "Float",
    "HeldOut",
    "Int",
    "LoopEstimate",
    "MoveEvent",
    "MoveKind",
    "NcMove",
    "NcState",
    "Notice",
    "Outcome",
    "ParameterSet",
    "Parameters",
    "Prediction",
    "Reason",
    "Recording",
    "Result",
    "Skill",
    "SlowVoltage",
    "Stages",
    "TableSamples",
    "TableSignal",
    "Temperature",
    "TickTimes",
    "Trajectory",
    "Verdict",
    "VoltageSamples",
    "VoltageSampling",
    "Window",
    "WindowOutcome",
    "Zone",
    "frozen",
    "frozen_ints",
    "read_only",
    "rms",
    "table_path",
    "unit_of",
]
