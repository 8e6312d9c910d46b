"""After unsent speed and torque offsets the feed-forward continues from what the drive holds."""

from __future__ import annotations

from itertools import pairwise

from tests.guard.feedforward_machine import LIMITS, switched_on


def test_unsent_feedforward_frames_cause_no_step() -> None:
    bench = switched_on()
    held = [bench.outputs[-1].feed]
    bench.targets = lambda: [0, 0]  # type: ignore[method-assign] # the NC jumps back: the law asks for far less
    for left in (True, False, False, True):
        held.append(bench.run_sync(unsent=() if left else (0, 1)).feed)
        if not left:
            del held[-2]
    for before, after in pairwise(held):
        assert before is not None
        assert after is not None
        for (speed, _), (next_speed, _) in zip(before, after, strict=True):
            assert next_speed == 0 or abs(next_speed - speed) <= LIMITS.speed_rate
    assert any(before != after for before, after in pairwise(held))
