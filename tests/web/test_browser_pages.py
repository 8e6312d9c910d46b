"""Each page in chromium, with a running daemon and simulator: accessible on any screen."""

from __future__ import annotations

import re
from collections.abc import Iterator, Set
from typing import TYPE_CHECKING

import pytest

from fdhil.web.app import SHELL
from tests.web.stage import Stage
from tests.web.tab import WIDE, Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ViewportSize

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
PAGES = (
    "machine", "axis", "live", "rapids", "rapid", "refused", "history", "program", "forecast", "events", "panel",
)  # fmt: skip
AT_400_PERCENT: ViewportSize = {"width": WIDE[0] // 4, "height": 256}  # WCAG 2.1, 1.4.10: of a window of 1280 x 1024


@pytest.fixture(scope="module")
def token(stage: Stage) -> str:
    return stage.token("watcher")


@pytest.fixture(scope="module")
def paths(stage: Stage, token: str) -> dict[str, str]:
    return stage.paths(token)


@pytest.fixture
def reader(stage: Stage, chromium: Browser, token: str) -> Iterator[Tab]:
    with opened(chromium, stage.url) as tab:
        tab.log_in(token)
        yield tab


def test_every_page_is_looked_at(paths: dict[str, str]) -> None:
    assert set(paths) == set(PAGES)
    assert {path.split("/")[1] for path in paths.values()} == set(SHELL)


def without_digits(labels: Set[str]) -> set[str]:
    return {re.sub(r"\d", "", label) for label in labels}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_is_for_everyone(page: str, paths: dict[str, str], reader: Tab) -> None:
    """axe reports nothing in light and dark mode; at 400 % nothing is lost, without scrolling sideways or motion."""
    reader.page.emulate_media(reduced_motion="reduce")
    reader.open(paths[page])
    reader.page.locator("#standing .state").filter(has_text=re.compile(".")).wait_for(state="attached")
    assert reader.page.title().endswith("fdhil")
    assert reader.page.locator("h1").count() == 1
    assert reader.wider() == []
    assert reader.violations() == []
    wide = reader.labels()
    reader.page.emulate_media(color_scheme="dark")
    assert reader.violations("color-contrast") == []
    reader.page.set_viewport_size(AT_400_PERCENT)
    assert without_digits(wide) - without_digits(reader.labels()) == set()  # notices may come meanwhile
    assert reader.wider() == []
    assert reader.page.evaluate("document.getAnimations().length") == 0


@pytest.mark.parametrize(("locale", "title"), [("de-DE", "Ereignisse"), ("fr-FR", "Événements"), ("it-IT", "Events")])
def test_pages_are_in_the_language_of_the_browser(
    locale: str, title: str, stage: Stage, chromium: Browser, token: str
) -> None:
    with opened(chromium, stage.url, locale=locale) as tab:
        tab.log_in(token)
        tab.open("/events")
        assert tab.page.locator("h1").inner_text() == title
        assert tab.page.evaluate("document.documentElement.lang") in (locale[:2], "en")
        assert tab.violations() == []
