"""Fixtures of the browser tests: all processes, chromium, and an empty tab."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

RAPIDS = 24  # of each axis: a fortnight
pytest.register_assert_rewrite("tests.web.browser_tab")

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from tests.web.browser_tab import BrowserTab
    from tests.web.web_rig import WebRig


@pytest.fixture(scope="package")
def web_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebRig]:
    from tests.web.web_rig import open_rig

    with open_rig(tmp_path_factory.mktemp("stage"), RAPIDS) as stage:
        yield stage


@pytest.fixture(scope="module")
def chromium_browser() -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    from tests.web.browser_tab import start_browser

    with sync_playwright() as playwright:
        browser = start_browser(playwright)
        yield browser
        browser.close()


@pytest.fixture
def browser_tab(web_rig: WebRig, chromium_browser: Browser) -> Iterator[BrowserTab]:
    from tests.web.browser_tab import open_tab

    with open_tab(chromium_browser, web_rig.url) as tab:
        yield tab
