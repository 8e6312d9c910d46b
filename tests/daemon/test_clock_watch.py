"""A clock that is set or behind is reported once, at start and while running."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from fdhil.daemon.clock_watch import ClockWatch, find_newest_record_s
from fdhil.records import Notice
from fdhil.store.history_database import History
from fdhil.store.history_rows import TimeStamp
from tests.daemon.simulated_machine import SimulatedMachine, config_of
from tests.daemon.test_daemon_service import serving, status_when

NOW_S = 1_800_000_000.0


@pytest.mark.fault("A28")
@pytest.mark.parametrize("jump_s", [3600.0, -3600.0, -NOW_S])
def test_set_clock_is_reported_once(jump_s: float) -> None:
    watch = ClockWatch(None)
    assert [watch.check_clock(NOW_S + k, 5.0 + k) for k in (0, 10, 20)] == [[], [], []]
    (result,) = watch.check_clock(NOW_S + 30 + jump_s, 35.0)
    way = "forward" if jump_s > 0 else "back"
    assert (result.code, f"{way} by {abs(jump_s):.0f} s" in result.text) == ("ClockJump", True)
    assert watch.check_clock(NOW_S + 40 + jump_s, 45.0) == []


def test_slewed_clock_is_not_reported() -> None:
    watch = ClockWatch(NOW_S + 30.0)  # a record of half a minute later: two clocks of one machine
    assert [watch.check_clock(NOW_S + 1.0005 * 10 * k, 10.0 * k) for k in range(100)] == [[]] * 100


@pytest.mark.fault("F9")
async def test_clock_behind_the_history_is_reported_at_start(tmp_path: Path) -> None:
    config = config_of(tmp_path)
    assert find_newest_record_s(config.store.directory) is None
    with History.open(config.store.directory) as history:
        history.add_notice(Notice("Armed", "info", "in two hours"), TimeStamp(time.time() + 7200.0, "boot", 1))
    async with serving(config, SimulatedMachine()) as path:
        status = await status_when(path, lambda shown_status: shown_status["unacknowledged"]["newest"])
    shown_status = {notice["code"]: notice["text"] for notice in status["unacknowledged"]["newest"]}
    assert "the newest record is 2.0 h later" in shown_status["ClockJump"]
