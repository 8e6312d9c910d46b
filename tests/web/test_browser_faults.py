"""The pages in a real browser without a daemon, and on a slow network."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.web.browser_tab import BrowserTab, open_tab
from tests.web.web_rig import WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
SLOW = 40_000  # byte/s, and 0.3 s to and fro: a telephone at the edge of a hall
CRAWLING = 3_000


@pytest.fixture
def reader(web_rig: WebRig, chromium_browser: Browser) -> Iterator[BrowserTab]:
    with open_tab(chromium_browser, web_rig.url) as tab:
        tab.log_in(web_rig.log_in_for_token("watcher"))
        yield tab


def test_page_reports_dead_daemon_and_resumes(web_rig: WebRig, reader: BrowserTab) -> None:
    reader.open_page("/live")
    running = reader.get_text("live.running").partition("{")[0]
    reader.wait_for_text("main", running)
    reader.wait_for_text("#standing", reader.get_text("state", state="OFF"))
    assert web_rig.stop("daemon") == 0
    try:
        reader.wait_for_text("#told", reader.get_text("daemon.silent"))
        reader.wait_for_text("#standing", reader.get_text("state.unknown"))
    finally:
        web_rig.start_daemon()
    reader.wait_for_text("#told", reader.get_text("daemon.back"))
    reader.wait_for_text("#standing", reader.get_text("state", state="OFF"))
    reader.wait_for_text("main", running)


def test_slow_network_loads_pages_and_live_reports_skipped_samples(reader: BrowserTab) -> None:
    reader.throttle_network(SLOW)
    reader.open_page("/live")
    running = reader.get_text("live.running").partition("{")[0]
    reader.wait_for_text("main", running)
    reader.throttle_network(CRAWLING)
    reader.wait_for_text("main p[role=status]", reader.get_text("live.coarser").partition("{")[0])
    reader.throttle_network(0)
    reader.wait_for_text("main", running)
