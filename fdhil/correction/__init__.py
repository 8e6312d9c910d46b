"""Plans offsets that make up for the predicted path error: methods, limits, the gate, and the guard's table."""

from __future__ import annotations

from fdhil.correction.limits import PlanLimits, check
from fdhil.correction.planning import plan, table

__all__ = ["PlanLimits", "check", "plan", "table"]
