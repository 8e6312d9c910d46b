"""Lays the frames of a PDO on a dense grid of ticks, and tracks sniffed set-points. Pure numpy, no loop per frame."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from fdhil.cia402 import PdoEntry
from fdhil.drivers.can.sync_grid import TickedFrames
from fdhil.drivers.cia402.drive_profile import PdoSpec
from fdhil.records import Bool, Int

JUDGED_TICKS = 1000
MOST = 0.75

Words = npt.NDArray[np.uint64]


def decode_entry(entry: PdoEntry, data: Words) -> Int:
    """Return the integers (n,) that ``entry`` maps in the frames' data words (n,): little-endian, sign-extended."""
    top = data << np.uint64(64 - entry.bits - entry.bit_offset)
    right = 64 - entry.bits
    # the entry's sign bit is now bit 63, so an arithmetic shift extends it
    return top.view(np.int64) >> np.int64(right) if entry.signed else (top >> np.uint64(right)).astype(np.int64)


@dataclass(slots=True)
class DecoderCounters:
    """Counts of a decoder: frames lost, too short, too long, duplicated, late, and ambiguous."""

    lost: int = 0
    short: int = 0
    long: int = 0
    duplicates: int = 0
    late: int = 0
    ambiguous: int = 0


@dataclass(slots=True)
class PdoQueue:
    """Frames of one PDO that wait until their ticks are complete; ``tick`` (m,) never decreases.

    ``first_tick`` is that of the first complete frame, None before it. ``synchronous``: present in most of the newest
    ``JUDGED_TICKS`` SYNCs; otherwise it is sent on change, by a timer, or no more.
    """

    spec: PdoSpec
    cob_id: int
    tick: Int = field(default_factory=lambda: np.empty(0, np.int64))
    data: Words = field(default_factory=lambda: np.empty(0, np.uint64))
    length: int = field(init=False)
    first_tick: int | None = None
    synchronous: bool = True
    _due: int = 0
    _gone: int = 0

    def __post_init__(self) -> None:
        self.length = self.spec.length

    def add_frames(self, ticked: TickedFrames, counters: DecoderCounters) -> None:
        """Add this PDO's frames of a block; a short one is discarded, of a long one the mapped bytes are used."""
        mine = (ticked.can_id == self.cob_id).nonzero()[0]
        if mine.size == 0:
            return
        length = ticked.length[mine]
        if (length != self.length).any():
            whole = length >= self.length
            counters.short += int(mine.size - np.count_nonzero(whole))
            counters.long += int(np.count_nonzero(length > self.length))
            mine = mine[whole]
        if self.first_tick is None and mine.size:
            self.first_tick = int(ticked.tick[mine[0]])
        self.tick = np.concatenate([self.tick, ticked.tick[mine]])
        self.data = np.concatenate([self.data, ticked.data[mine]])

    def count_lost(self, missing: Int, due: Int, first: int) -> int:
        """Return the frames lost on samples (n,) from tick ``first`` on: those ``missing`` of the ``due`` ones.

        None counts as lost before the first received frame, nor while the PDO is not synchronous.
        """
        if self.first_tick is None:
            return 0
        begun = slice(max(0, self.first_tick - first), None)
        gone = int(missing[begun].sum())
        self._due, self._gone = self._due + int(due[begun].sum()), self._gone + gone
        if self._due >= JUDGED_TICKS:
            self.synchronous = self._gone <= MOST * self._due
            self._due = self._gone = 0
        return gone if self.synchronous else 0

    def drop_before(self, before_tick: int) -> None:
        """Drop frames older than ``before_tick``."""
        start = int(np.searchsorted(self.tick, before_tick))
        if start:
            self.tick, self.data = self.tick[start:], self.data[start:]

    def select_ticks(self, first: int, stop: int) -> tuple[Int, Words]:
        """Return tick and data of the frames of ticks [first, stop)."""
        low, high = self.tick.searchsorted((first, stop))
        return self.tick[low:high], self.data[low:high]

    def get_gapless_data(self, first: int, stop: int) -> Words | None:
        """Return the data of ticks [first, stop) when exactly one frame came in each of them, else None."""
        tick, data = self.select_ticks(first, stop)
        regular = tick.size == stop - first and bool((tick == np.arange(first, stop)).all())
        return data if regular else None


@dataclass(frozen=True, slots=True)
class DensePdo:
    """A PDO on every tick of [first, first + n): data ``words`` (n,), ``present`` (n,) and ``ambiguous`` (n,).

    Of equal frames in one tick the first is used; different ones are ambiguous (one may be late, or another
    producer's), so none is used. ``count`` (n,) is the number received.
    """

    words: Words
    present: Bool
    ambiguous: Bool
    count: Int

    def find_certain_ticks(self, between: Int) -> Bool:
        """Return the ticks (n,) whose frame surely is theirs; the next SYNC came ``between`` (n,) periods later."""
        return self.present & ((between <= 1) | (self.count >= between))

    def balance_frames(self, due: Int) -> tuple[Int, Int, Int]:
        """Return the numbers of missing, late and surplus frames, each (n - 1,), where ``due`` (n,) were expected.

        A late frame came after the next received SYNC: one too few before it, one too many behind it.
        """
        missing, spare = np.maximum(due - self.count, 0), np.where(due > 0, np.maximum(self.count - due, 0), 0)
        received = np.flatnonzero(due > 0)
        late = np.zeros(due.size, np.int64)
        late[received[:-1]] = (missing[received[:-1]] > 0) & (spare[received[1:]] > 0)
        return (missing - late)[:-1], late[:-1], spare[:-1]


def lay_on_grid(queue: PdoQueue, first: int, stop: int) -> DensePdo:
    """Lay the queue's frames of ticks [first, stop) on the grid."""
    n = stop - first
    regular = queue.get_gapless_data(first, stop)
    if regular is not None:
        return DensePdo(regular, np.ones(n, np.bool_), np.zeros(n, np.bool_), np.ones(n, np.int64))
    tick, data = queue.select_ticks(first, stop)
    place = tick - first
    words = np.zeros(n, np.uint64)
    words[place[::-1]] = data[::-1]
    count = np.bincount(place, minlength=n)
    ambiguous = np.zeros(n, np.bool_)
    if tick.size > np.count_nonzero(count):
        ambiguous[place[data != words[place]]] = True
    return DensePdo(words, (count > 0) & ~ambiguous, ambiguous, count)


@dataclass(frozen=True, slots=True)
class SetpointSamples:
    """A set-point on samples [first, stop): ``value`` (n,), ``certain`` (n,), and the number of lost frames."""

    value: Int
    certain: Bool
    lost: int


class SniffedSetpoint:
    """A sniffed set-point: latched at each SYNC, held while none comes, uncertain where one may have been lost.

    ``held`` is the value in force before the frames in the queue, None while it is unknown.
    """

    def __init__(self, queue: PdoQueue, entry: PdoEntry, delay: int) -> None:
        self.queue = queue
        self.held: int | None = None
        self._entry = entry
        self._streaming = False
        self._held_crowded = False  # several frames in its tick: the SYNC between them was lost
        self.shift = delay + 1  # a frame after SYNC j is latched at SYNC j+1 and in force ``delay`` cycles later
        self._reach = delay + 2  # a gap is bridged as far as frames are there when its sample is released

    def compute_samples(self, first: int, stop: int) -> SetpointSamples | None:
        """Return the set-point in force on samples [first, stop); None while it is unknown."""
        regular = self.queue.get_gapless_data(first - self.shift, stop - self.shift)
        if regular is not None:
            return SetpointSamples(decode_entry(self._entry, regular), np.ones(stop - first, np.bool_), 0)
        ticks, words, doubtful, crowded = self._select_latched()
        values = decode_entry(self._entry, words)
        wanted = np.arange(first - self.shift, stop - self.shift)
        at = np.searchsorted(ticks, wanted, side="right") - 1
        if self.held is None and (ticks.size == 0 or at[-1] < 0):
            return None
        if ticks.size == 0:
            return SetpointSamples(np.full(wanted.size, self.held, np.int64), np.ones(wanted.size, np.bool_), 0)
        now = np.maximum(at, 0)
        value = np.where(at >= 0, values[now], self.held if self.held is not None else 0)
        exact = (at >= 0) & (ticks[now] == wanted)
        following = np.minimum(at + 1, ticks.size - 1)
        gap = ~exact & (at + 1 < ticks.size) & (ticks[following] - wanted < self._reach)
        gap &= ((at >= 0) & (wanted - ticks[now] < self._reach)) | ((at < 0) & self._streaming)
        certain = ~(gap & (values[following] != value)) & ~(exact & doubtful[now])
        if self.held is None:
            certain &= at >= 0
        before_gap = np.where(at >= 0, crowded[now], self._held_crowded)
        lost = int(np.count_nonzero(gap & ~before_gap))
        return SetpointSamples(value, certain, lost)

    def _select_latched(self) -> tuple[Int, Words, Bool, Bool]:
        """Return tick and last word of each tick, whether its frames differed, and whether there were several."""
        tick, data = self.queue.tick, self.queue.data
        if tick.size == 0:
            return tick, data, np.empty(0, np.bool_), np.empty(0, np.bool_)
        last = np.append(np.flatnonzero(np.diff(tick)), tick.size - 1)
        doubtful = np.zeros(last.size, np.bool_)
        if last.size < tick.size:
            group = np.searchsorted(tick[last], tick)
            doubtful[np.unique(group[data != data[last][group]])] = True
        return tick[last], data[last], doubtful, np.diff(last, prepend=-1) > 1

    def drop_before(self, row: int) -> None:
        """Drop frames that no sample from ``row`` on needs; the newest of them is held."""
        keep = row - self.shift
        count = int(np.searchsorted(self.queue.tick, keep))
        if count:
            self.held = int(decode_entry(self._entry, self.queue.data[count - 1 : count])[0])
            self._held_crowded = count > 1 and bool(self.queue.tick[count - 2] == self.queue.tick[count - 1])
            self._streaming = int(self.queue.tick[count - 1]) >= keep - self._reach
            self.queue.drop_before(keep)
