"""Watches this PC's clock: nothing that is measured or sent depends on it, but what is kept is dated by it."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.records import Notice
from fdhil.store.history import History

JUMP_S = 2.0  # between two looks; what a clock is slewed by is less
BEHIND_S = 60.0


def newest_record_s(folder: Path) -> float | None:
    """Return when the newest record of the history was written, in s since 1970; None where nothing tells."""
    with suppress(StoreError), History.read(folder) as history:
        notices = [notice.stamp.wall_s for notice in history.notices(limit=1)]
        return max([*notices, *(window.stamp.wall_s for window in history.windows(limit=1))], default=None)
    return None


class ClockWatch:
    """Tells once that the clock is behind ``newest_s``, the newest record, and each time that it was set."""

    def __init__(self, newest_s: float | None) -> None:
        self._newest_s = newest_s
        self._ahead_s: float | None = None

    def look(self, wall_s: float, monotonic_s: float) -> list[Notice]:
        """Return what there is to say of the clock now, beside one that only runs."""
        before_s, self._ahead_s = self._ahead_s, wall_s - monotonic_s
        if before_s is None:
            return self._behind(wall_s)
        jump_s = self._ahead_s - before_s
        if abs(jump_s) <= JUMP_S:
            return []
        way = "forward" if jump_s > 0 else "back"
        return [Notice("ClockJump", "minor", f"this PC's clock went {way} by {abs(jump_s):.0f} s: it was set")]

    def _behind(self, wall_s: float) -> list[Notice]:
        if self._newest_s is None or self._newest_s <= wall_s + BEHIND_S:
            return []
        shown, hours = time.strftime("%Y-%m-%d %H:%M", time.gmtime(wall_s)), (self._newest_s - wall_s) / 3600.0
        text = f"it is {shown} UTC by this PC, and the newest record is from {hours:.1f} h later"
        return [Notice("ClockJump", "minor", text)]
