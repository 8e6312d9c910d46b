"""Evenness of SYNC and delay of its answers, from frames with time stamps."""

from __future__ import annotations

import numpy as np
import pytest

from fdhil.commissioning.timing import judge_answers, judge_sync, measure
from fdhil.drivers.can.frame_ring import Frames, pack_frames

PERIOD_S = 0.001
TPDO = 0x181


def heard(answer_us: int = 200, hole: int = 0) -> Frames:
    """200 answered SYNCs, with a gap of ``hole`` periods after the hundredth."""
    rows = []
    for k in range(200):
        t_ns = 1_000_000 * (k + (hole if k > 100 else 0)) + (3000 if k % 2 else 0)
        rows += [(t_ns, 0x080, b""), (t_ns + 1000 * answer_us, TPDO, bytes(8)), (t_ns + 5000, 0x701, b"\x05")]
    return pack_frames(sorted(rows))


def test_an_even_sync_passes_and_its_jitter_is_told() -> None:
    timing = measure(heard(), [TPDO])
    finding = judge_sync(timing.interval_s, PERIOD_S, counted=False)
    assert (finding.ok, finding.found) == (True, "p50 3, p99 3, max 3 us")
    (answer,) = judge_answers(timing, PERIOD_S, counted=False)
    assert (answer.ok, answer.found) == (True, "p50 0.20, p99 0.20 ms after SYNC")


def test_a_hole_that_would_end_a_correction_is_told() -> None:
    finding = judge_sync(measure(heard(hole=4), [TPDO]).interval_s, PERIOD_S, counted=False)
    assert finding.ok is False
    assert finding.cause.startswith("SampleTiming: 5.0 ms passed between two SYNCs, more than 3 periods")
    assert judge_sync(measure(heard(hole=4), [TPDO]).interval_s, PERIOD_S, counted=True).ok is True


def test_an_answer_as_late_as_the_next_sync_is_told() -> None:
    (answer,) = judge_answers(measure(heard(answer_us=980), [TPDO]), PERIOD_S, counted=False)
    assert answer.ok is False
    assert "answers arrive up to 0.98 ms after SYNC" in answer.cause


@pytest.mark.parametrize("frames", [heard()[:0], heard()[1:3], heard()[:20]])
def test_too_little_tells_nothing(frames: Frames) -> None:
    timing = measure(frames, [TPDO])
    assert judge_sync(timing.interval_s, PERIOD_S, counted=False).ok is None
    assert all(np.isfinite(timing.answer_s))
