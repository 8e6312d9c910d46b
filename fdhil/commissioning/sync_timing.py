"""Assess the evenness of SYNC, and how fast a drive answers it, from received frames. Pure."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fdhil.cia402 import COB_SYNC
from fdhil.commissioning.finding import Finding
from fdhil.drivers import Frames
from fdhil.records import Float, freeze_array

LONGEST = 3.0  # periods between two SYNCs: after a longer gap the guard ends a correction
CODE = "SampleTiming"
LEAST_SYNCS = 50


@dataclass(frozen=True, slots=True)
class SyncTiming:
    """Intervals between SYNCs (n,), s, and delays of a drive's answers after their SYNC (m,), s."""

    interval_s: Float
    answer_s: Float


def measure_timing(frames: Frames, tpdos: Collection[int]) -> SyncTiming:
    """Return the timing of frames by their arrival stamps; ``tpdos`` are the drive's COB-IDs."""
    sync = frames["t_ns"][frames["id"] == COB_SYNC]
    answers = frames["t_ns"][np.isin(frames["id"], list(tpdos))]
    place = np.searchsorted(sync, answers, side="right") - 1
    after = (answers - sync[np.maximum(place, 0)])[place >= 0] if sync.size else answers[:0]
    return SyncTiming(freeze_array(np.diff(sync) * 1e-9), freeze_array(after * 1e-9))


def assess_sync_jitter(interval_s: Float | Sequence[float], period_s: float, counted: bool) -> Finding:
    """Compare the evenness of SYNC with the guard's interlock; ``counted``: time is the SYNC count alone."""
    intervals = np.asarray(interval_s, np.float64)
    expected = f"none over {LONGEST:g} periods"
    if intervals.size < LEAST_SYNCS:
        return Finding("SYNC jitter", expected, "too few SYNCs", None, "too few were received", "let it run longer")
    off_us = np.abs(intervals - period_s) * 1e6
    shown = f"p50 {np.median(off_us):.0f}, p99 {np.percentile(off_us, 99):.0f}, max {off_us.max():.0f} us"
    longest = float(intervals.max())
    even = counted or longest <= LONGEST * period_s
    cause = f"{CODE}: {longest * 1e3:.1f} ms passed between two SYNCs, more than {LONGEST:g} periods ({shown})"
    advice = "reduce the load of the SYNC producer and give it a real-time priority; the guard would end a correction"
    return Finding("SYNC jitter", "counted, not timed" if counted else expected, shown, even, cause, advice)


def assess_answer_delay(timing: SyncTiming, period_s: float, counted: bool) -> Iterator[Finding]:
    """Check that answers arrive before the next SYNC: otherwise samples are assigned to the wrong one."""
    expected, answers = f"before the next SYNC ({period_s * 1e3:g} ms)", timing.answer_s
    if not answers.size:
        return
    late = float(np.percentile(answers, 99))
    shown = f"p50 {np.median(answers) * 1e3:.2f}, p99 {late * 1e3:.2f} ms after SYNC"
    cause = f"{CODE}: its answers arrive up to {late * 1e3:.2f} ms after SYNC, as late as the next one"
    advice = "raise the bit rate, map fewer objects, or lengthen the cycle"
    yield Finding("answer to SYNC", expected, shown, counted or late < 0.95 * period_s, cause, advice)
