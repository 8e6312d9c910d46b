"""Fixtures of the browser tests: all processes, chromium, and an empty tab."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

RAPIDS = 24  # of each axis: a fortnight
pytest.register_assert_rewrite("tests.web.tab")

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from tests.web.stage import Stage
    from tests.web.tab import Tab


@pytest.fixture(scope="package")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    from tests.web.stage import opened

    with opened(tmp_path_factory.mktemp("stage"), RAPIDS) as stage:
        yield stage


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    from playwright.sync_api import sync_playwright

    from tests.web.tab import started

    with sync_playwright() as playwright:
        browser = started(playwright)
        yield browser
        browser.close()


@pytest.fixture
def tab(stage: Stage, chromium: Browser) -> Iterator[Tab]:
    from tests.web.tab import opened

    with opened(chromium, stage.url) as tab:
        yield tab
