"""Each page in chromium, with a running daemon and simulator: accessible on any screen."""

from __future__ import annotations

import re
from collections.abc import Iterator, Set
from typing import TYPE_CHECKING

import pytest

from fdhil.web.application import SHELL
from tests.web.browser_tab import WIDE, BrowserTab, open_tab
from tests.web.web_rig import WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ViewportSize

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
PAGES = (
    "machine", "axis", "live", "rapids", "rapid", "refused", "history", "program", "forecast", "events", "panel",
)  # fmt: skip
AT_400_PERCENT: ViewportSize = {"width": WIDE[0] // 4, "height": 256}  # WCAG 2.1, 1.4.10: of a window of 1280 x 1024


@pytest.fixture(scope="module")
def token(web_rig: WebRig) -> str:
    return web_rig.log_in_for_token("watcher")


@pytest.fixture(scope="module")
def paths(web_rig: WebRig, token: str) -> dict[str, str]:
    return web_rig.list_paths(token)


@pytest.fixture
def reader(web_rig: WebRig, chromium_browser: Browser, token: str) -> Iterator[BrowserTab]:
    with open_tab(chromium_browser, web_rig.url) as tab:
        tab.log_in(token)
        yield tab


def test_every_page_is_examined(paths: dict[str, str]) -> None:
    assert set(paths) == set(PAGES)
    assert {path.split("/")[1] for path in paths.values()} == set(SHELL)


def remove_digits(labels: Set[str]) -> set[str]:
    return {re.sub(r"\d", "", label) for label in labels}


@pytest.mark.parametrize("page", PAGES)
def test_page_is_accessible(page: str, paths: dict[str, str], reader: BrowserTab) -> None:
    """axe reports nothing in light and dark mode; at 400 % nothing is lost, without scrolling sideways or motion."""
    reader.page.emulate_media(reduced_motion="reduce")
    reader.open_page(paths[page])
    reader.page.locator("#standing .state").filter(has_text=re.compile(".")).wait_for(state="attached")
    assert reader.page.title().endswith("fdhil")
    assert reader.page.locator("h1").count() == 1
    assert reader.find_overflow() == []
    assert reader.find_violations() == []
    wide = reader.list_labels()
    reader.page.emulate_media(color_scheme="dark")
    assert reader.find_violations("color-contrast") == []
    reader.page.set_viewport_size(AT_400_PERCENT)
    assert remove_digits(wide) - remove_digits(reader.list_labels()) == set()  # notices may come meanwhile
    assert reader.find_overflow() == []
    assert reader.page.evaluate("document.getAnimations().length") == 0


@pytest.mark.parametrize(("locale", "title"), [("de-DE", "Ereignisse"), ("fr-FR", "Événements"), ("it-IT", "Events")])
def test_pages_use_browser_language(
    locale: str, title: str, web_rig: WebRig, chromium_browser: Browser, token: str
) -> None:
    with open_tab(chromium_browser, web_rig.url, locale=locale) as tab:
        tab.log_in(token)
        tab.open_page("/events")
        assert tab.page.locator("h1").inner_text() == title
        assert tab.page.evaluate("document.documentElement.lang") in (locale[:2], "en")
        assert tab.find_violations() == []
