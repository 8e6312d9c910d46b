"""Interpret ISO 6983 programs and read recorded demands: the motion that the NC will command."""

from fdhil.program.budget import Budget
from fdhil.program.demand_csv import write_demand_csv
from fdhil.program.interpreter import interpret
from fdhil.program.loading import load_trajectory, program_digest
from fdhil.program.motions import Arc, Dwell, Feed, Motion, Probe, Rapid, Turned
from fdhil.program.planner import plan

__all__ = [
    "Arc",
    "Budget",
    "Dwell",
    "Feed",
    "Motion",
    "Probe",
    "Rapid",
    "Turned",
    "interpret",
    "load_trajectory",
    "plan",
    "program_digest",
    "write_demand_csv",
]
