"""The pages in a real browser without a daemon, and on a slow network."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.web.stage import Stage
from tests.web.tab import Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
SLOW = 40_000  # byte/s, and 0.3 s to and fro: a telephone at the edge of a hall
CRAWLING = 3_000


@pytest.fixture
def reader(stage: Stage, chromium: Browser) -> Iterator[Tab]:
    with opened(chromium, stage.url) as tab:
        tab.log_in(stage.token("watcher"))
        yield tab


def test_a_dead_daemon_is_told_and_the_page_goes_on_when_it_is_back(stage: Stage, reader: Tab) -> None:
    reader.open("/live")
    running = reader.word("live.running").partition("{")[0]
    reader.says("main", running)
    reader.says("#standing", reader.word("state", state="OFF"))
    assert stage.stop("daemon") == 0
    try:
        reader.says("#told", reader.word("daemon.silent"))
        reader.says("#standing", reader.word("state.unknown"))
    finally:
        stage.start_daemon()
    reader.says("#told", reader.word("daemon.back"))
    reader.says("#standing", reader.word("state", state="OFF"))
    reader.says("main", running)


def test_on_a_slow_network_pages_come_and_the_live_one_tells_what_it_leaves_out(reader: Tab) -> None:
    reader.slow(SLOW)
    reader.open("/live")
    running = reader.word("live.running").partition("{")[0]
    reader.says("main", running)
    reader.slow(CRAWLING)
    reader.says("main p[role=status]", reader.word("live.coarser").partition("{")[0])
    reader.slow(0)
    reader.says("main", running)
