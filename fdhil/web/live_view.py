"""Selects what one browser still has to receive: complete columns, fewer and wider ones if it cannot keep up.

Pure. A browser acknowledges the messages that it has drawn. While two are unacknowledged nothing is sent; the backlog
is then sent in columns that are twice, four times ... as wide, and what is older than the view is skipped and counted.
"""

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdhil.web.live_ring import SampleRing, SignalEnvelope

MOST_UNSEEN = 2
BURST_S = 0.5  # sent in full resolution by one message


class LiveView:
    """The state of one browser: ``axes`` over the newest ``seconds`` in so many ``columns``."""

    def __init__(self, axes: Sequence[str], seconds: float, columns: int, period_s: float) -> None:
        self._axes = axes
        self._ticks = round(seconds / period_s)
        self._burst = max(1, round(BURST_S / period_s))
        self.per_column = max(1, self._ticks // columns)
        self._next: dict[str, int] = {}
        self._number = self._seen = 0

    def may_send(self) -> bool:
        return self._number - self._seen < MOST_UNSEEN

    def acknowledge_drawn(self, number: int) -> bool:
        """Acknowledge message ``number``; return whether it is new."""
        before, self._seen = self._seen, max(self._seen, min(number, self._number))
        return self._seen > before

    def has_new_columns(self, rings: Mapping[str, SampleRing]) -> bool:
        return any(rings[axis].end - self._next.get(axis, rings[axis].begin) >= self.per_column for axis in self._axes)

    def make_message(self, rings: Mapping[str, SampleRing], fields: Mapping[str, Any]) -> bytes:
        """Return the new columns as one message: a length (uint32), a JSON header, and float32 numbers.

        The header lists the parts; each has (signals, columns) minima, then as many maxima.
        """
        self._number += 1
        parts = [(axis, *self._make_part(axis, rings[axis])) for axis in self._axes]
        listed = [
            {
                "axis": axis,
                "first_tick": part.first_tick,
                "per_column": part.per_column,
                "columns": part.low.shape[1],
                "signals": part.low.shape[0],
                "skipped_ticks": skipped,
            }
            for axis, part, skipped in parts
            if part.low.shape[1]
        ]
        header = json.dumps({**fields, "number": self._number, "parts": listed}).encode()
        header += b" " * (-len(header) % 4)
        numbers = [values.tobytes() for _, part, _ in parts for values in (part.low, part.high)]
        return b"".join([len(header).to_bytes(4, "little"), header, *numbers])

    def _make_part(self, axis: str, ring: SampleRing) -> tuple[SignalEnvelope, int]:
        oldest = max(ring.begin, ring.end - self._ticks)
        first = self._next.get(axis, oldest)
        skipped = max(0, oldest - first)
        width = self.per_column
        while axis in self._next and ring.end - max(first, oldest) > self._burst * (width // self.per_column):
            width *= 2
        begin = max(first, oldest)
        part = ring.compute_envelope(begin // width * width if axis in self._next else begin, ring.end, width)
        if part.low.shape[1]:
            self._next[axis] = part.first_tick + part.low.shape[1] * width
        return part, skipped if part.low.shape[1] else 0


def round_finite(values: np.ndarray[Any, Any]) -> list[float | None]:
    """Return numbers for JSON: None for non-finite ones."""
    return [round(value, 4) if math.isfinite(value) else None for value in values.tolist()]
