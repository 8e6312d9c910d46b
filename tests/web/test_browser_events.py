"""Notices, acknowledgement and black boxes in chromium, with a running daemon and simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from tests.web.browser_tab import BrowserTab, open_tab
from tests.web.web_rig import WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]


@contextmanager
def open_events_tab(name: str, stage: WebRig, chromium: Browser) -> Iterator[BrowserTab]:
    with open_tab(chromium, stage.url) as tab:
        tab.log_in(stage.log_in_for_token(name))
        yield tab


def count_waiting(stage: WebRig) -> set[int]:
    kinds = stage.send_request("/api/events", None, stage.log_in_for_token("watcher"))["waiting"]
    return {number for kind in kinds for number in kind["numbers"]}


def test_notice_is_acknowledged_by_keyboard_and_stays_so(web_rig: WebRig, chromium_browser: Browser) -> None:
    web_rig.wait_for_status(lambda status: status["unacknowledged"]["count"])
    with open_events_tab("operator", web_rig, chromium_browser) as tab:
        tab.open_page("/events")
        button = tab.page.get_by_role("button", name="Acknowledge notice").first
        number = int("".join(filter(str.isdecimal, str(button.get_attribute("aria-label")).partition(":")[0])))
        assert number in count_waiting(web_rig)
        button.focus()
        tab.page.keyboard.press("Enter")
        tab.page.keyboard.type("seen by keyboard")
        assert tab.find_violations() == []
        tab.page.keyboard.press("Enter")
        tab.page.get_by_text("seen by keyboard").first.wait_for()
        assert number not in count_waiting(web_rig)
        tab.page.reload()
        tab.page.get_by_text("seen by keyboard").first.wait_for()


def test_watcher_has_no_acknowledge_button(web_rig: WebRig, chromium_browser: Browser) -> None:
    with open_events_tab("watcher", web_rig, chromium_browser) as tab:
        tab.open_page("/events")
        tab.page.get_by_text("To acknowledge in the browser").wait_for()
        assert tab.page.get_by_role("button", name="Acknowledge").count() == 0


def test_event_list_is_filtered_by_address(web_rig: WebRig, chromium_browser: Browser) -> None:
    with open_events_tab("watcher", web_rig, chromium_browser) as tab:
        tab.open_page("/events?code=LoadChanged")
        classes = tab.page.locator("article .class code").all_text_contents()
        assert classes
        assert set(classes) == {"LoadChanged"}
        tab.page.get_by_label("Class").select_option("")
        tab.page.wait_for_url("**/events")


def test_black_box_is_shown_and_downloaded(web_rig: WebRig, chromium_browser: Browser) -> None:
    with open_events_tab("watcher", web_rig, chromium_browser) as tab:
        tab.open_page("/events")
        tab.page.get_by_role("button", name="Show the drives' signals").first.click()
        tab.page.locator("#black-box").wait_for()
        assert tab.find_violations() == []
        with tab.page.expect_download() as saved:
            tab.page.get_by_role("button", name="Download 2").first.click()
        assert saved.value.suggested_filename.endswith(".log")
        assert " can0 080#" in saved.value.path().read_text("ascii")


def test_trend_is_readable_as_table(web_rig: WebRig, chromium_browser: Browser) -> None:
    with open_events_tab("watcher", web_rig, chromium_browser) as tab:
        tab.open_page("/history/X")
        tab.page.get_by_role("group", name="R over time").wait_for()
        summary = tab.page.locator("summary").first
        summary.focus()
        tab.page.keyboard.press("Enter")
        assert tab.page.locator("details[open] td").first.inner_text()
        tab.page.get_by_role("link", name="Y", exact=True).click()
        tab.page.get_by_role("heading", name="History of axis Y").wait_for()
