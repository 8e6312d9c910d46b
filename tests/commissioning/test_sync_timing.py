"""Evenness of SYNC and delay of its answers, from frames with time stamps."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.commissioning.sync_timing import assess_answer_delay, assess_sync_jitter, measure_timing
from fdhil.drivers.can.frame_ring import Frames, pack_frames

PERIOD_S = 0.001
TPDO = 0x181


def build_frames(answer_us: int = 200, hole: int = 0) -> Frames:
    """200 answered SYNCs, with a gap of ``hole`` periods after the hundredth."""
    rows = []
    for k in range(200):
        t_ns = 1_000_000 * (k + (hole if k > 100 else 0)) + (3000 if k % 2 else 0)
        rows += [(t_ns, 0x080, b""), (t_ns + 1000 * answer_us, TPDO, bytes(8)), (t_ns + 5000, 0x701, b"\x05")]
    return pack_frames(sorted(rows))


def test_even_sync_passes_with_reported_jitter() -> None:
    timing = measure_timing(build_frames(), [TPDO])
    finding = assess_sync_jitter(timing.interval_s, PERIOD_S, counted=False)
    assert (finding.ok, finding.found) == (True, "p50 3, p99 3, max 3 us")
    (answer,) = assess_answer_delay(timing, PERIOD_S, counted=False)
    assert (answer.ok, answer.found) == (True, "p50 0.20, p99 0.20 ms after SYNC")


def test_gap_that_would_end_correction_is_reported() -> None:
    finding = assess_sync_jitter(measure_timing(build_frames(hole=4), [TPDO]).interval_s, PERIOD_S, counted=False)
    assert finding.ok is False
    assert finding.cause.startswith("SampleTiming: 5.0 ms passed between two SYNCs, more than 3 periods")
    assert (
        assess_sync_jitter(measure_timing(build_frames(hole=4), [TPDO]).interval_s, PERIOD_S, counted=True).ok is True
    )


def test_answer_as_late_as_next_sync_is_reported() -> None:
    (answer,) = assess_answer_delay(measure_timing(build_frames(answer_us=980), [TPDO]), PERIOD_S, counted=False)
    assert answer.ok is False
    assert "answers arrive up to 0.98 ms after SYNC" in answer.cause


@pytest.mark.parametrize("frames", [build_frames()[:0], build_frames()[1:3], build_frames()[:20]])
def test_few_syncs_are_not_assessed(frames: Frames) -> None:
    timing = measure_timing(frames, [TPDO])
    assert assess_sync_jitter(timing.interval_s, PERIOD_S, counted=False).ok is None
    assert all(np.isfinite(timing.answer_s))
