"""Plans offsets that compensate the predicted path error: methods, limits, the gate."""

from __future__ import annotations

from fdhil.correction.correction_planner import plan_correction
from fdhil.correction.plan_limits import PlanLimits, check_offsets

__all__ = ["PlanLimits", "check_offsets", "plan_correction"]
