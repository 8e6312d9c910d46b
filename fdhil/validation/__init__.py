"""Checks what was measured and what was fitted: a literal table of checks over one record of evidence.

Nothing is believed that was not checked. The table never raises on any signals; what cannot be believed has a reason.
"""

from __future__ import annotations

from fdhil.validation.checks import BEFORE_ANY_FIT, OF_THE_FIT, WEIGHED, Check, Findings, ask
from fdhil.validation.evidence import LEAST_ROWS, Evidence

__all__ = ["BEFORE_ANY_FIT", "LEAST_ROWS", "OF_THE_FIT", "WEIGHED", "Check", "Evidence", "Findings", "ask"]
