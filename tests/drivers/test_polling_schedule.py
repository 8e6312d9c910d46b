"""Request times of sensors that hold one value, and the numbers of the values received. No I/O except the clock."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fdhil.drivers.can.tick_clock import TickClock
from fdhil.drivers.free_running_index import FreeRunningIndex
from fdhil.drivers.polling_schedule import PollingSchedule
from fdhil.records import TickTimes

MS = 1_000_000


def build_tick_clock(last: int, *, held_up_ms: int = 0) -> TickClock:
    """Return SYNCs 1 ms apart from 0 ns on; the producer was delayed after tick 100."""
    clock = TickClock(0.001)
    tick = np.arange(last + 1)
    clock.add_arrivals(TickTimes(tick, tick * MS + np.where(tick > 100, held_up_ms * MS, 0)))
    return clock


@pytest.mark.parametrize("phase", [0.0, 0.5])
def test_polls_stay_on_the_sync_count_across_pauses(phase: float) -> None:
    grid, ticks = PollingSchedule(0.01, 0.001, phase), build_tick_clock(1000, held_up_ms=80)
    for now_ms in (1081, 1083, 1090, 1095):
        number, due_ns = grid.schedule_next(now_ms * MS, ticks)
        tick = (number + phase) * 10
        assert due_ns == pytest.approx((tick + 80) * MS, abs=1.0)
        assert now_ms * MS <= due_ns
    assert grid.missed == 0
    number, _ = grid.schedule_next(1300 * MS, ticks)
    assert grid.missed > 0


def test_reading_time_lies_between_request_and_answer() -> None:
    grid, ticks = PollingSchedule(0.01, 0.001), build_tick_clock(1000)
    number, due_ns = grid.schedule_next(985 * MS, ticks)
    due = round(due_ns)
    assert due == 990 * MS
    at, late, off = grid.locate_reading(number, due + 200_000, due + 700_000, ticks)
    assert (at, late, off) == pytest.approx((due + 450_000, 450_000, 250_000), abs=1000)
    _, late, off = grid.locate_reading(number, due - 3 * MS, due + 1 * MS, ticks)
    assert (late, off) == pytest.approx((-1 * MS, 2 * MS), abs=1000)


def test_schedule_uses_the_host_clock_without_sync() -> None:
    grid, ticks = PollingSchedule(0.01, 0.001), TickClock(0.001)
    number, due_ns = grid.schedule_next(25 * MS, ticks)
    assert (number, due_ns) == (3, 30 * MS)
    assert grid.locate_reading(number, 30 * MS, 31 * MS, ticks) == (30.5 * MS, 0.5 * MS, 0.5 * MS)
    assert grid.schedule_next(26 * MS, ticks)[0] == 4
    running = build_tick_clock(1000)
    assert grid.schedule_next(1001 * MS, running)[0] == 101
    assert grid.missed == 0  # another count
    assert grid.schedule_next(1700 * MS, running)[0] == 170  # SYNC has ended


@settings(max_examples=60, deadline=None)
@example(drift=159.4e-6, late=[0.0] * 10 + [0.32002289982716375] + [0.0] * 19, lost=set(), held_up=True)
@given(
    drift=st.floats(-200e-6, 200e-6),
    late=st.lists(st.floats(0, 0.5), min_size=30, max_size=80),
    lost=st.sets(st.integers(10, 79), max_size=4),
    held_up=st.booleans(),
)
def test_free_running_values_keep_their_numbers(drift: float, late: list[float], lost: set[int], held_up: bool) -> None:
    """Either this computer was late, with all values received since, or values were lost."""
    count, last, right = FreeRunningIndex(0.01), 0.0, []
    for k, delay in enumerate(late):
        if k in lost and not held_up:
            continue
        held = 5 * delay if held_up and k % 7 == 3 else 0.0
        last = max(last, (k * (1 + drift) + held) * 10 * MS)
        right.append(count.assign_number(round(last)) == k)
    assert right.count(False) <= (0 if held_up else len(lost))  # the one behind a lost one is set right by the next
