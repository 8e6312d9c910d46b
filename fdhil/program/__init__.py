"""Interpret ISO 6983 programs and read recorded demands: the motion that the NC will command."""

from fdhil.program.budget import Budget
from fdhil.program.demand_csv import write_demand_csv
from fdhil.program.interpreter import interpret
from fdhil.program.motions import Arc, AxisMove, Dwell, Feed, Motion, Probe, Rapid
from fdhil.program.planner import plan
from fdhil.program.program_loading import compute_program_digest, load_trajectory

__all__ = [
    "Arc",
    "AxisMove",
    "Budget",
    "Dwell",
    "Feed",
    "Motion",
    "Probe",
    "Rapid",
    "compute_program_digest",
    "interpret",
    "load_trajectory",
    "plan",
    "write_demand_csv",
]
