"""Plans offsets that compensate the predicted path error: methods, limits, the gate."""

from __future__ import annotations

from fdhil.correction.limits import PlanLimits, check
from fdhil.correction.planning import plan

__all__ = ["PlanLimits", "check", "plan"]
