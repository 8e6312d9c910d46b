"""Follows a loaded table while the guard is off, to show what would be sent.

It works on a copy of the core's state and appears in the status only; nothing of it is sent.
"""

from fdhil.guard.corrected_path import CorrectedPath
from fdhil.guard.guard_protocol import Mode
from fdhil.guard.guard_state import GuardState
from fdhil.guard.path_tracking import await_start, track_path


class ShadowCorrection:
    """Follows one table as an armed guard would, without interlocks; restarts where the path is lost or ends."""

    def __init__(self) -> None:
        self._path: CorrectedPath | None = None
        self._start_row = 0
        self._state: GuardState | None = None
        self._before: GuardState | None = None

    def follow_table(self, state: GuardState, path: CorrectedPath | None) -> None:
        """Take the SYNC that ``state`` has processed."""
        rested, self._before = self._before or state, state
        if state.mode is not Mode.OFF or path is None:
            self._path = self._state = None
            return
        if path is not self._path:
            self._path, self._state, self._start_row = path, None, path.count_standing_rows()
        before = self._state
        if before is None:
            waiting = state._replace(rest=rested.rest, rested_for=rested.rested_for, start_row=self._start_row)
            started, _ = await_start(waiting._replace(mode=Mode.ARMED, places=()), path)
            self._state = started if started.places else None
            return
        found, lost = track_path(before._replace(targets=state.targets), path)
        ended = not path.has_row(found.places[0].row + 1)
        self._state = None if ended or (lost is not None and lost.code != "FeedHold") else found

    def get_offsets(self) -> tuple[int, ...] | None:
        """Return what would be sent now, increments per axis; None while the machine is off the path."""
        if self._state is None or self._path is None:
            return None
        return self._path.get_row_offsets(self._state.places[0].row + 1)
