"""A source that yields the records of stored windows, so that a replay runs the very code that the machine runs."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable

from fdhil.records import Window


class ReplaySource:
    """Yields ``windows`` in order as :meth:`MachineSource.records` yields a machine's."""

    def __init__(self, windows: Iterable[Window]) -> None:
        self._windows = windows
        self._count = 0

    async def records(self) -> AsyncIterator[Window]:
        """Yield each window once."""
        for window in self._windows:
            self._count += 1
            yield window

    def counters(self) -> dict[str, int]:
        """Windows that were yielded."""
        return {"windows": self._count}
