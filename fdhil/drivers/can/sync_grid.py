"""Assigns frames to SYNC ticks: each gets the tick of the last SYNC before it. Pure: no clock, no I/O.

With a counter byte (0x1019, 1 to at most 240) lost SYNCs are counted and the grid stays correct; without one a lost
SYNC cannot be detected, and each SYNC is one tick. Arrival times are used only to distinguish 1 from 241 periods, and
to detect at once a counter that wraps before 240. After a silence longer than ``LONGEST_SILENCE_S`` the grid restarts:
the counter then fits any time, so the tick is advanced by that much and no more, however long the NC was off.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fdhil.cia402 import COB_SYNC
from fdhil.drivers.can.frame_ring import Frames
from fdhil.drivers.can.sync_producers import SyncProducerMonitor
from fdhil.records import Int, Notice, TickTimes

COUNTER_RANGE = 240
LONGEST_SILENCE_S = 60.0  # twice the reach of a window: none has samples from both sides
_SHORT_RANGE = 16  # with so short a counter, backward and forward are indistinguishable
_STEADY = 0.25  # of a period
_UNCOUNTED = 8  # SYNCs without a counter, one after the other, until the producer with one is gone


@dataclass(frozen=True, slots=True)
class TickedFrames:
    """Frames as columns (n,): ``can_id``, ``length``, ``data`` and ``tick``, and the SYNCs among them: ``syncs``.

    ``last_tick`` is the newest SYNC's, -1 before the first one.
    """

    can_id: npt.NDArray[np.uint32]
    length: npt.NDArray[np.uint8]
    data: npt.NDArray[np.uint64]
    tick: Int
    syncs: TickTimes
    last_tick: int
    notices: tuple[Notice, ...] = ()


class SyncGrid:
    """Counts SYNC cycles of one bus from 0 at the first received SYNC."""

    def __init__(self, sync_period_s: float, realtime: bool = True) -> None:
        self._period_ns = sync_period_s * 1e9
        self._realtime = realtime
        self._longest_silence = round(LONGEST_SILENCE_S / sync_period_s)
        self._silence_left = self._longest_silence
        self._last_tick = -1
        self._last_counter: int | None = None
        self._last_ns: int | None = None
        self._suspect: int | None = None  # counter of a SYNC that went backwards
        self._range = COUNTER_RANGE
        self._wrapped_at: int | None = None
        self._uncounted_run = 0
        self._producers = SyncProducerMonitor(sync_period_s, realtime)
        self._collision = False
        self.missed = 0
        self.duplicates = 0
        self.out_of_order = 0

    def assign_ticks(self, frames: Frames) -> TickedFrames:
        """Give every frame its tick; a SYNC has the tick that it starts."""
        # contiguous: compared and shifted once per PDO
        can_id, length, data = (np.ascontiguousarray(frames[name]) for name in ("id", "dlc", "data"))
        where = np.flatnonzero(can_id == COB_SYNC)
        before = self._last_tick
        self._silence_left = self._longest_silence
        if where.size == 0:
            empty = TickTimes(np.empty(0, np.int64), np.empty(0, np.int64))
            return TickedFrames(can_id, length, data, np.full(frames.size, before, np.int64), empty, before)
        syncs = frames[where]
        ticks = self._count_syncs(syncs)
        kept = ticks >= 0
        where, ticks, stamps = where[kept], ticks[kept], syncs["t_ns"][kept].astype(np.int64)
        starts = np.concatenate([[before], ticks])
        tick = starts[np.searchsorted(where, np.arange(frames.size), side="right")]
        notices = self._detect_collision(stamps)
        return TickedFrames(can_id, length, data, tick, TickTimes(ticks, stamps), self._last_tick, notices)

    def _count_syncs(self, syncs: Frames) -> Int:
        """Return the tick of every SYNC, -1 for a duplicate or one out of order."""
        counters = (syncs["data"] & np.uint64(0xFF)).astype(np.int64)
        counted = syncs["dlc"] > 0
        regular = np.arange(1, syncs.size + 1) + self._last_tick
        if self._last_tick < 0 and self._last_counter is None and counted[0]:
            self._last_counter = (int(counters[0]) - 2) % self._range + 1
        if self._last_counter is None and not counted.any():
            self._accept_regular_block(regular, None, syncs)
            return regular
        if self._last_counter is not None and counted.all():
            expected = (self._last_counter + np.arange(syncs.size)) % self._range + 1
            if np.array_equal(expected, counters) and not self._has_long_pause(syncs):
                self._accept_regular_block(regular, int(counters[-1]), syncs)
                return regular
        ticks = [
            self._count_irregular_sync(int(c) if has else None, int(t))
            for c, has, t in zip(counters, counted, syncs["t_ns"], strict=True)
        ]
        return np.array(ticks, np.int64)

    def _has_long_pause(self, syncs: Frames) -> bool:
        """Return whether the counter may have wrapped fully between two of these SYNCs."""
        before = syncs["t_ns"][0] if self._last_ns is None else self._last_ns
        stamps = np.concatenate([[before], syncs["t_ns"]])
        return self._realtime and bool(np.diff(stamps).max() > self._range // 2 * self._period_ns)

    def _accept_regular_block(self, ticks: Int, counter: int | None, syncs: Frames) -> None:
        self._last_tick = int(ticks[-1])
        self._last_counter = counter
        self._last_ns = int(syncs["t_ns"][-1])
        self._suspect = None
        self._uncounted_run = 0
        self._producers.note_regular_block(syncs.size, counter)

    def _count_irregular_sync(self, counter: int | None, t_ns: int) -> int:
        self._producers.note_irregular_sync(counter, self._range)
        if counter is None or self._last_counter is None:
            return self._count_uncounted_sync(counter, t_ns)
        self._uncounted_run = 0
        self._learn_range(counter, t_ns)
        ahead = (counter - self._last_counter) % self._range
        whole_turns = self._count_missed_turns(ahead, t_ns)
        if ahead == 0 and whole_turns == 0:
            self.duplicates += 1
            return -1
        backward = self._range >= _SHORT_RANGE and ahead > self._range // 2
        if backward and whole_turns == 0 and not self._is_restarted(counter):
            self.out_of_order += 1
            self._suspect = counter
            return -1
        self._suspect = None
        ahead += self._range * whole_turns
        self.missed += ahead - 1
        return self._advance_tick(ahead, counter, t_ns)

    def _learn_range(self, counter: int, t_ns: int) -> None:
        """Learn the counter's range (0x1019) from where it wraps to 1: by time, or at the second wrap."""
        last = self._last_counter
        if counter > self._range:
            self._range = COUNTER_RANGE
        if counter != 1 or last is None or last < 2:
            return
        elapsed = (t_ns - self._last_ns) / self._period_ns if self._realtime and self._last_ns is not None else 0.0
        if abs(elapsed - (1 - last) % self._range) < _STEADY and last != self._range:
            return  # the end of the turn was lost: the elapsed time fits the former range
        if 0.0 < elapsed < 1.5 or last == self._wrapped_at:
            self._range = last
        self._wrapped_at = last

    def _count_uncounted_sync(self, counter: int | None, t_ns: int) -> int:
        self._uncounted_run = self._uncounted_run + 1 if counter is None else 0
        if counter is None and self._last_counter is not None and self._uncounted_run < _UNCOUNTED:
            # a second producer without a counter next to the one that counts
            self.out_of_order += 1
            return -1
        if counter is None:
            self._producers.note_regular_block(1, None)
        return self._advance_tick(1, counter, t_ns)

    def _advance_tick(self, ahead: int, counter: int | None, t_ns: int) -> int:
        self._last_tick += ahead
        self._last_counter = counter
        self._last_ns = t_ns
        return self._last_tick

    def _is_restarted(self, counter: int) -> bool:
        """Return whether a counter that went backwards counts on from there: its producer was restarted."""
        return self._suspect is not None and (counter - self._suspect) % self._range == 1

    def _count_missed_turns(self, ahead: int, t_ns: int) -> int:
        """Return the full turns of the counter that were not received.

        The elapsed time must fit a whole number of turns within 2 %; a simulated machine that was paused fits none. The
        turns of one block are limited to the longest silence, or one for each SYNC.
        """
        if not self._realtime or self._last_ns is None:
            return 0
        elapsed = (t_ns - self._last_ns) / self._period_ns
        turns = round((elapsed - ahead) / self._range)
        fits = max(min(2.0, self._range / 8), 0.02 * elapsed)
        if turns <= 0 or abs(elapsed - ahead - turns * self._range) > fits:
            return 0
        counted = max(1, min(turns, self._silence_left // self._range))
        self._silence_left -= counted * self._range
        return counted

    def _detect_collision(self, stamps: Int) -> tuple[Notice, ...]:
        self._producers.note_stamps(stamps)
        was, self._collision = self._collision, self._producers.has_two_producers
        if not self._collision or was:
            return ()
        text = "Two nodes send SYNC: the sampling grid is invalid; leave only one SYNC producer on the bus."
        return (Notice("SyncCollision", "MAJOR", text, tick=self._last_tick),)
