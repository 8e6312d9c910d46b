"""Watches this PC's clock: no measurement or transmission depends on it, but records are dated by it."""

import time
from contextlib import suppress
from pathlib import Path

from fdhil.errors import StoreError
from fdhil.records import Notice
from fdhil.store import History

JUMP_S = 2.0  # between two checks; slewing a clock changes less
BEHIND_S = 60.0


def find_newest_record_s(folder: Path) -> float | None:
    """Return the date of the history's newest record, s since 1970; None where there is none."""
    with suppress(StoreError), History.open_read_only(folder) as history:
        notices = [notice.stamp.wall_s for notice in history.read_notices(limit=1)]
        return max([*notices, *(window.stamp.wall_s for window in history.read_windows(limit=1))], default=None)
    return None


class ClockWatch:
    """Reports once that the clock is behind ``newest_s``, the newest record, and each time that it was set."""

    def __init__(self, newest_s: float | None) -> None:
        self._newest_s = newest_s
        self._ahead_s: float | None = None

    def check_clock(self, wall_s: float, monotonic_s: float) -> list[Notice]:
        """Return notices about the clock; none while it only runs."""
        before_s, self._ahead_s = self._ahead_s, wall_s - monotonic_s
        if before_s is None:
            return self._check_behind_history(wall_s)
        jump_s = self._ahead_s - before_s
        if abs(jump_s) <= JUMP_S:
            return []
        way = "forward" if jump_s > 0 else "back"
        return [Notice("ClockJump", "minor", f"this PC's clock was set {way} by {abs(jump_s):.0f} s")]

    def _check_behind_history(self, wall_s: float) -> list[Notice]:
        if self._newest_s is None or self._newest_s <= wall_s + BEHIND_S:
            return []
        shown, hours = time.strftime("%Y-%m-%d %H:%M", time.gmtime(wall_s)), (self._newest_s - wall_s) / 3600.0
        text = f"this PC's clock shows {shown} UTC, but the newest record is {hours:.1f} h later"
        return [Notice("ClockJump", "minor", text)]
