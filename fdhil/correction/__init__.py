"""Offsets that make up for the predicted path error: methods, limits, the gate."""

from __future__ import annotations

from fdhil.correction.limits import Limits, check
from fdhil.correction.planning import default_method, plan

__all__ = ["Limits", "check", "default_method", "plan"]
