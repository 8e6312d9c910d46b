"""The live page in a real browser: frozen, zoomed to single samples and read, by keyboard."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.web.browser_tab import NARROW, BrowserTab, open_tab
from tests.web.web_rig import WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
STATE = "main p[role=status]"
CURRENT = "figure.chart:has(figcaption:has-text('Current'))"


@pytest.fixture
def phone(web_rig: WebRig, chromium_browser: Browser) -> Iterator[BrowserTab]:
    with open_tab(chromium_browser, web_rig.url, NARROW) as tab:
        tab.log_in(web_rig.log_in_for_token("watcher"))
        yield tab


def test_live_page_is_frozen_zoomed_and_read_by_keyboard(phone: BrowserTab) -> None:
    phone.open_page("/live?axis=X&seconds=2")
    phone.wait_for_text(STATE, phone.get_text("live.running").partition("{")[0])
    assert phone.page.locator("tbody tr").count() == 1  # the axis of the link alone
    chart = phone.page.locator(f"{CURRENT} .plot")
    reading = phone.page.locator(f"{CURRENT} output")
    while not reading.text_content():  # what has come is drawn a little later
        chart.press("ArrowLeft")  # the cursor stands near the newest, and what is enlarged is there
    place_s = float((reading.text_content() or "").partition(" s")[0])
    for _ in range(5):
        phone.page.keyboard.press("+")
    phone.wait_for_text(STATE, phone.get_text("live.frozen.single").partition(",")[0])
    stayed_s = float((reading.text_content() or "").partition(" s")[0])
    assert stayed_s == pytest.approx(place_s, abs=0.004)
    phone.page.keyboard.press("ArrowLeft")
    first = reading.text_content() or ""
    assert re.search(r"^-[\d.]+ s: X .* A$", first), first
    phone.page.keyboard.press("ArrowLeft")
    second = reading.text_content() or ""
    places = [float(told.partition(" s")[0]) for told in (first, second)]
    assert places[0] - places[1] == pytest.approx(0.002, abs=2e-5)  # one sample, at the stage's SYNC
    phone.wait_for_text("caption", phone.get_text("live.values.at").partition("{")[0])
    phone.page.keyboard.press("Home")
    phone.wait_for_text(STATE, phone.get_text("live.frozen"))
    phone.page.get_by_role("button", name=phone.get_text("live.go")).press("Enter")
    phone.wait_for_text(STATE, phone.get_text("live.running").partition("{")[0])


def test_selection_is_kept_in_the_address(phone: BrowserTab) -> None:
    phone.open_page("/live")
    phone.wait_for_text(STATE, phone.get_text("live.running").partition("{")[0])
    phone.page.get_by_label(phone.get_text("live.seconds")).select_option("5")
    phone.page.get_by_label("Y", exact=True).uncheck()
    phone.wait_for_text(STATE, phone.get_text("live.running").partition("{")[0])
    phone.page.wait_for_url("**/live?axis=X&seconds=5")
    phone.page.reload()
    phone.wait_until_ready()
    phone.wait_for_text(STATE, phone.get_text("live.running").partition("{")[0])
    assert not phone.page.get_by_label("Y", exact=True).is_checked()
    assert phone.page.get_by_label(phone.get_text("live.seconds")).input_value() == "5"
