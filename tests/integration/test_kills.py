"""A sample of the study of kills, hangs, restarts and faults, and a check that its judges detect errors."""

from __future__ import annotations

from pathlib import Path

import pytest

from fdhil.guard import guard_step, interlock_checks, offset_limits
from fdhil.guard.offset_limits import OffsetLimits
from studies import kills
from studies.fault_rows import RAMPED, Descent, assess_ramp_down
from studies.live_guard import LiveGuard
from tests.fault_matrix import ROWS
from tests.tiers import sampled

LIMITS = OffsetLimits(offset=819, rate=65, acceleration=6, variation=9830, window=1000)


@pytest.mark.parametrize("row", sampled(RAMPED, every=3))
def test_fault_at_any_time_ends_at_zero_in_time(row: str) -> None:
    assert RAMPED[row].code in ROWS[row].classes or not ROWS[row].classes or row == "F3"
    found = kills.run_frame_part(row, 3, 7)
    assert found.wrong == []
    assert len(found.descents[row]) == 3


@pytest.mark.usefixtures("processes")
@pytest.mark.fault("F15")
def test_killed_process_ends_at_zero() -> None:
    found = kills.run_live_part("kills", 1, 3)
    assert found.wrong == []
    assert found.frames > 100


@pytest.mark.usefixtures("processes")
def test_rig_arms_again_after_an_abandoned_correction(tmp_path: Path) -> None:
    live = LiveGuard(tmp_path)
    try:
        live.start_guard()
        live.arm()
        live.give_up()
        live.run_into_cut()
        assert any(live.offsets)
    finally:
        live.close()


@pytest.mark.socketcan
@pytest.mark.fault("A10", "A15", "F14", "F15", "F16")
@pytest.mark.parametrize(
    ("part", "times"),
    [("kills", 3), ("restarts", 6), ("hangs", 1), ("faults", 8)],
)
def test_fault_at_any_time_ends_at_zero_on_socketcan(part: str, times: int) -> None:
    found = kills.run_live_part(part, times, 1, "socketcan")
    assert found.wrong == []
    assert found.counts["frames while hung"] == 0


def test_ramp_down_is_checked_by_its_bounds() -> None:
    down = [(300, 0), *[(300 - 6 * k, 0) for k in range(51)]]
    assert assess_ramp_down(down, 0, LIMITS, 2) == Descent(1, 51, within=False)
    assert assess_ramp_down(down, 0, LIMITS, 20) == Descent(1, 51, within=True)
    assert assess_ramp_down([(300, 0), (301, 0), (0, 0)], 0, LIMITS, 2) == Descent(2, 2, within=True)
    assert assess_ramp_down([(0, 9)] * 60 + [(0, 10), (0, 0)], 0, LIMITS, 2) == Descent(61, 61, within=False)
    assert assess_ramp_down(down[:-1], 0, LIMITS, 20) is None


def test_guard_that_misses_a_fault_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard_step, interlock_checks.list_failing_interlocks.__name__, lambda _bus, _views: ())
    assert kills.run_frame_part("E11", 1, 7).wrong


def test_guard_that_steps_to_zero_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        guard_step,
        offset_limits.move_toward_goal.__name__,
        lambda _limits, _offset, _rate, wanted, _rate_wanted: wanted,
    )
    monkeypatch.setattr(
        guard_step, offset_limits.find_limit_violation.__name__, lambda _limits, _before, _rate, _offset: None
    )
    assert any("a step" in each for each in kills.run_frame_part("F15", 20, 7).wrong)
