"""The live page in a real browser: frozen, zoomed to single samples and read, by keyboard."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.web.stage import Stage
from tests.web.tab import NARROW, Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
STATE = "main p[role=status]"
CURRENT = "figure.chart:has(figcaption:has-text('Current'))"


@pytest.fixture
def phone(stage: Stage, chromium: Browser) -> Iterator[Tab]:
    with opened(chromium, stage.url, NARROW) as tab:
        tab.log_in(stage.token("watcher"))
        yield tab


def test_it_is_frozen_enlarged_and_read_off_by_the_keyboard(phone: Tab) -> None:
    phone.open("/live?axis=X&seconds=2")
    phone.says(STATE, phone.word("live.running").partition("{")[0])
    assert phone.page.locator("tbody tr").count() == 1  # the axis of the link alone
    chart = phone.page.locator(f"{CURRENT} .plot")
    reading = phone.page.locator(f"{CURRENT} output")
    while not reading.text_content():  # what has come is drawn a little later
        chart.press("ArrowLeft")  # the cursor stands near the newest, and what is enlarged is there
    place_s = float((reading.text_content() or "").partition(" s")[0])
    for _ in range(5):
        phone.page.keyboard.press("+")
    phone.says(STATE, phone.word("live.frozen.single").partition(",")[0])
    stayed_s = float((reading.text_content() or "").partition(" s")[0])
    assert stayed_s == pytest.approx(place_s, abs=0.004)
    phone.page.keyboard.press("ArrowLeft")
    first = reading.text_content() or ""
    assert re.search(r"^-[\d.]+ s: X .* A$", first), first
    phone.page.keyboard.press("ArrowLeft")
    second = reading.text_content() or ""
    places = [float(told.partition(" s")[0]) for told in (first, second)]
    assert places[0] - places[1] == pytest.approx(0.002, abs=2e-5)  # one sample, at the stage's SYNC
    phone.says("caption", phone.word("live.values.at").partition("{")[0])
    phone.page.keyboard.press("Home")
    phone.says(STATE, phone.word("live.frozen"))
    phone.page.get_by_role("button", name=phone.word("live.go")).press("Enter")
    phone.says(STATE, phone.word("live.running").partition("{")[0])


def test_what_is_chosen_is_in_the_address(phone: Tab) -> None:
    phone.open("/live")
    phone.says(STATE, phone.word("live.running").partition("{")[0])
    phone.page.get_by_label(phone.word("live.seconds")).select_option("5")
    phone.page.get_by_label("Y", exact=True).uncheck()
    phone.says(STATE, phone.word("live.running").partition("{")[0])
    phone.page.wait_for_url("**/live?axis=X&seconds=5")
    phone.page.reload()
    phone.ready()
    phone.says(STATE, phone.word("live.running").partition("{")[0])
    assert not phone.page.get_by_label("Y", exact=True).is_checked()
    assert phone.page.get_by_label(phone.word("live.seconds")).input_value() == "5"
