"""The Python interface, offered as ``import fdhil``; the command line uses the same functions.

Its names follow semantic versioning: within one major version they keep their meaning.
"""

from __future__ import annotations

from fdhil.api.machine import Machine, correct, plan, predict
from fdhil.api.model import Model, Simulation, simulate
from fdhil.api.recordings import Recording, read
from fdhil.api.result import Parameter, Result, identify

__all__ = [
    "Machine",
    "Model",
    "Parameter",
    "Recording",
    "Result",
    "Simulation",
    "correct",
    "identify",
    "plan",
    "predict",
    "read",
    "simulate",
]
