"""Nothing is believed that was not checked: plausibility before any fit, the model's behaviour after it.

``analyse`` judges one window, ``pool`` the accepted windows of one drive together. Neither raises on any data: what
cannot be believed is a refused :class:`~fdhil.records.Verdict` with its reasons.
"""

from __future__ import annotations

from fdhil.validation.pooled import pool
from fdhil.validation.window import analyse

__all__ = ["analyse", "pool"]
