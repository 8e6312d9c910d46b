"""The rapids in a real browser: filtered, opened, examined by keyboard, compared, saved."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from fdhil.daemon.outcome_store import WINDOWS_FOLDER
from tests.web.browser_tab import BrowserTab, open_tab
from tests.web.web_rig import WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]


@pytest.fixture
def reader(web_rig: WebRig, chromium_browser: Browser) -> Iterator[BrowserTab]:
    with open_tab(chromium_browser, web_rig.url) as tab:
        tab.log_in(web_rig.log_in_for_token("watcher"))
        yield tab


def _read_rows(page: Page) -> list[str]:
    return page.locator("tbody th").all_inner_texts()


def test_rapid_filter_is_kept_in_the_address(reader: BrowserTab) -> None:
    page = reader.page
    reader.open_page("/rapids")
    everything = _read_rows(page)
    page.get_by_label(reader.get_text("rapids.verdict"), exact=True).select_option("refused")
    page.wait_for_url("**/rapids?verdict=refused")
    page.get_by_label(reader.get_text("rapids.reason"), exact=True).select_option("StuckValue")
    page.wait_for_url("**/rapids?verdict=refused&code=StuckValue")
    page.locator("tbody tr").filter(has_not_text="StuckValue").first.wait_for(state="detached")
    chosen = _read_rows(page)
    assert chosen
    assert set(chosen) < set(everything)
    page.get_by_role("link", name=chosen[0], exact=True).click()
    page.get_by_role("heading", level=1, name=f"Rapid {chosen[0][2:]} of axis {chosen[0][0]}").wait_for()
    reader.wait_for_text("main", "StuckValue")
    page.go_back()
    page.get_by_role("link", name=chosen[0], exact=True).wait_for()
    assert _read_rows(page) == chosen


def test_chart_is_read_and_zoomed_by_keyboard(web_rig: WebRig, reader: BrowserTab) -> None:
    page = reader.page
    reader.open_page("/rapids?axis=X&verdict=accepted")
    reader.open_page(f"/rapids/{_read_rows(page)[0]}")
    page.get_by_role("table", name=reader.get_text("rapid.numbers")).wait_for()
    chart = page.locator("figure.chart").filter(has_text=reader.get_text("rapid.current_a")).first
    chart.locator(".plot").focus()
    page.keyboard.press("ArrowLeft")
    reading = chart.locator("output")
    assert reader.get_text("rapid.model") in reading.inner_text()
    before = reading.inner_text()
    page.keyboard.press("Shift+ArrowLeft")
    assert reading.inner_text() != before
    page.get_by_role("button", name=reader.get_text("rapid.accelerate")).click()
    page.get_by_role("button", name=reader.get_text("rapid.whole")).first.click()
    assert reader.find_overflow() == []


def test_two_marked_rapids_are_compared(reader: BrowserTab) -> None:
    page = reader.page
    reader.open_page("/rapids?axis=X&verdict=accepted")
    one, other = _read_rows(page)[:2]
    for name in (one, other):
        page.get_by_label(reader.get_text("rapids.compare.mark", id=name), exact=True).check()
    page.get_by_role("button", name=reader.get_text("rapids.compare.marked")).click()
    page.wait_for_url(f"**/rapids/{one}?with={other}")
    table = page.get_by_role("table", name=reader.get_text("rapid.numbers"))
    table.wait_for()
    assert f"{other} maximum" in table.inner_text()
    reader.wait_for_text("main", reader.get_text("rapid.compared.mirrored"))  # they went to and fro
    assert reader.find_violations() == []
    page.get_by_role("link", name=reader.get_text("rapid.compare.end")).click()
    page.wait_for_url(f"**/rapids/{one}")


def test_recording_is_downloaded_and_missing_one_reported(web_rig: WebRig, reader: BrowserTab) -> None:
    page = reader.page
    folder = web_rig.config.store.directory / WINDOWS_FOLDER
    reader.open_page("/rapids?axis=Y")
    reader.open_page(f"/rapids/{_read_rows(page)[-1]}")
    with page.expect_download() as saved:
        page.get_by_role("button", name=reader.get_text("rapid.download")).click()
    kept = folder / saved.value.suggested_filename
    content = kept.read_bytes()
    assert saved.value.path().read_bytes() == content
    kept.unlink()
    try:
        reader.expected.append(r"Failed to load resource: .* 404")
        page.reload()
        reader.wait_for_text("main", reader.get_text("rapid.gone"))
        assert page.get_by_role("button", name=reader.get_text("rapid.download")).count() == 0
    finally:
        kept.write_bytes(content)
