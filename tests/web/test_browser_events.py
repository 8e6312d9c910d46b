"""Notices, acknowledgement and black boxes in chromium, with a running daemon and simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

from tests.web.stage import Stage
from tests.web.tab import Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]


@contextmanager
def open_events_tab(name: str, stage: Stage, chromium: Browser) -> Iterator[Tab]:
    with opened(chromium, stage.url) as tab:
        tab.log_in(stage.token(name))
        yield tab


def waiting(stage: Stage) -> set[int]:
    kinds = stage.ask("/api/events", None, stage.token("watcher"))["waiting"]
    return {number for kind in kinds for number in kind["numbers"]}


def test_a_notice_is_acknowledged_with_the_keyboard_alone_and_stays_so(stage: Stage, chromium: Browser) -> None:
    stage.status_when(lambda status: status["unacknowledged"]["count"])
    with open_events_tab("operator", stage, chromium) as tab:
        tab.open("/events")
        button = tab.page.get_by_role("button", name="Acknowledge notice").first
        number = int("".join(filter(str.isdecimal, str(button.get_attribute("aria-label")).partition(":")[0])))
        assert number in waiting(stage)
        button.focus()
        tab.page.keyboard.press("Enter")
        tab.page.keyboard.type("seen by keyboard")
        assert tab.violations() == []
        tab.page.keyboard.press("Enter")
        tab.page.get_by_text("seen by keyboard").first.wait_for()
        assert number not in waiting(stage)
        tab.page.reload()
        tab.page.get_by_text("seen by keyboard").first.wait_for()


def test_who_may_only_look_is_told_how_to_acknowledge_and_has_no_button(stage: Stage, chromium: Browser) -> None:
    with open_events_tab("watcher", stage, chromium) as tab:
        tab.open("/events")
        tab.page.get_by_text("To acknowledge in the browser").wait_for()
        assert tab.page.get_by_role("button", name="Acknowledge").count() == 0


def test_the_list_is_filtered_by_its_address(stage: Stage, chromium: Browser) -> None:
    with open_events_tab("watcher", stage, chromium) as tab:
        tab.open("/events?code=LoadChanged")
        classes = tab.page.locator("article .class code").all_text_contents()
        assert classes
        assert set(classes) == {"LoadChanged"}
        tab.page.get_by_label("Class").select_option("")
        tab.page.wait_for_url("**/events")


def test_a_black_box_is_shown_and_given_as_a_file(stage: Stage, chromium: Browser) -> None:
    with open_events_tab("watcher", stage, chromium) as tab:
        tab.open("/events")
        tab.page.get_by_role("button", name="Show the drives' signals").first.click()
        tab.page.locator("#black-box").wait_for()
        assert tab.violations() == []
        with tab.page.expect_download() as saved:
            tab.page.get_by_role("button", name="Download 2").first.click()
        assert saved.value.suggested_filename.endswith(".log")
        assert " can0 080#" in saved.value.path().read_text("ascii")


def test_a_course_is_read_without_its_picture(stage: Stage, chromium: Browser) -> None:
    with open_events_tab("watcher", stage, chromium) as tab:
        tab.open("/history/X")
        tab.page.get_by_role("group", name="R over time").wait_for()
        summary = tab.page.locator("summary").first
        summary.focus()
        tab.page.keyboard.press("Enter")
        assert tab.page.locator("details[open] td").first.inner_text()
        tab.page.get_by_role("link", name="Y", exact=True).click()
        tab.page.get_by_role("heading", name="History of axis Y").wait_for()
