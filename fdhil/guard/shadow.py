"""Follows a loaded table while the guard is off, to show what would be sent.

It works on a copy of the core's state and appears in the status only; nothing of it is sent.
"""

from fdhil.guard.path import CorrectedPath
from fdhil.guard.protocol import Mode
from fdhil.guard.state import State
from fdhil.guard.tracking import await_start, track


class Shadow:
    """Follows one table as an armed guard would, without interlocks; restarts where the path is lost or ends."""

    def __init__(self) -> None:
        self._path: CorrectedPath | None = None
        self._start_row = 0
        self._state: State | None = None
        self._before: State | None = None

    def follow(self, state: State, path: CorrectedPath | None) -> None:
        """Take the SYNC that ``state`` has processed."""
        rested, self._before = self._before or state, state
        if state.mode is not Mode.OFF or path is None:
            self._path = self._state = None
            return
        if path is not self._path:
            self._path, self._state, self._start_row = path, None, path.standing_rows()
        before = self._state
        if before is None:
            waiting = state._replace(rest=rested.rest, rested_for=rested.rested_for, start_row=self._start_row)
            started, _ = await_start(waiting._replace(mode=Mode.ARMED, places=()), path)
            self._state = started if started.places else None
            return
        found, lost = track(before._replace(targets=state.targets), path)
        ended = not path.has(found.places[0].row + 1)
        self._state = None if ended or (lost is not None and lost.code != "FeedHold") else found

    def offsets(self) -> tuple[int, ...] | None:
        """Return what would be sent now, increments per axis; None while the machine is off the path."""
        if self._state is None or self._path is None:
            return None
        return self._path.offsets_at(self._state.places[0].row + 1)
