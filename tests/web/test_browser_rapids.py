"""The rapids in a real browser: filtered, opened, examined by keyboard, compared, saved."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from fdhil.daemon.outcome_store import WINDOWS_FOLDER
from tests.web.stage import Stage
from tests.web.tab import Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]


@pytest.fixture
def reader(stage: Stage, chromium: Browser) -> Iterator[Tab]:
    with opened(chromium, stage.url) as tab:
        tab.log_in(stage.token("watcher"))
        yield tab


def _rows(page: Page) -> list[str]:
    return page.locator("tbody th").all_inner_texts()


def test_rapids_are_chosen_and_the_address_keeps_the_choice(reader: Tab) -> None:
    page = reader.page
    reader.open("/rapids")
    everything = _rows(page)
    page.get_by_label(reader.word("rapids.verdict"), exact=True).select_option("refused")
    page.wait_for_url("**/rapids?verdict=refused")
    page.get_by_label(reader.word("rapids.reason"), exact=True).select_option("StuckValue")
    page.wait_for_url("**/rapids?verdict=refused&code=StuckValue")
    page.locator("tbody tr").filter(has_not_text="StuckValue").first.wait_for(state="detached")
    chosen = _rows(page)
    assert chosen
    assert set(chosen) < set(everything)
    page.get_by_role("link", name=chosen[0], exact=True).click()
    page.get_by_role("heading", level=1, name=f"Rapid {chosen[0][2:]} of axis {chosen[0][0]}").wait_for()
    reader.says("main", "StuckValue")
    page.go_back()
    page.get_by_role("link", name=chosen[0], exact=True).wait_for()
    assert _rows(page) == chosen


def test_a_chart_is_read_and_enlarged_by_the_keyboard(stage: Stage, reader: Tab) -> None:
    page = reader.page
    reader.open("/rapids?axis=X&verdict=accepted")
    reader.open(f"/rapids/{_rows(page)[0]}")
    page.get_by_role("table", name=reader.word("rapid.numbers")).wait_for()
    chart = page.locator("figure.chart").filter(has_text=reader.word("rapid.current_a")).first
    chart.locator(".plot").focus()
    page.keyboard.press("ArrowLeft")
    reading = chart.locator("output")
    assert reader.word("rapid.model") in reading.inner_text()
    before = reading.inner_text()
    page.keyboard.press("Shift+ArrowLeft")
    assert reading.inner_text() != before
    page.get_by_role("button", name=reader.word("rapid.accelerate")).click()
    page.get_by_role("button", name=reader.word("rapid.whole")).first.click()
    assert reader.wider() == []


def test_two_are_marked_and_compared(reader: Tab) -> None:
    page = reader.page
    reader.open("/rapids?axis=X&verdict=accepted")
    one, other = _rows(page)[:2]
    for name in (one, other):
        page.get_by_label(reader.word("rapids.compare.mark", id=name), exact=True).check()
    page.get_by_role("button", name=reader.word("rapids.compare.marked")).click()
    page.wait_for_url(f"**/rapids/{one}?with={other}")
    table = page.get_by_role("table", name=reader.word("rapid.numbers"))
    table.wait_for()
    assert f"{other} maximum" in table.inner_text()
    reader.says("main", reader.word("rapid.compared.mirrored"))  # they went to and fro
    assert reader.violations() == []
    page.get_by_role("link", name=reader.word("rapid.compare.end")).click()
    page.wait_for_url(f"**/rapids/{one}")


def test_a_recording_is_saved_as_it_is_and_one_that_is_gone_says_so(stage: Stage, reader: Tab) -> None:
    page = reader.page
    folder = stage.config.store.directory / WINDOWS_FOLDER
    reader.open("/rapids?axis=Y")
    reader.open(f"/rapids/{_rows(page)[-1]}")
    with page.expect_download() as saved:
        page.get_by_role("button", name=reader.word("rapid.download")).click()
    kept = folder / saved.value.suggested_filename
    content = kept.read_bytes()
    assert saved.value.path().read_bytes() == content
    kept.unlink()
    try:
        reader.expected.append(r"Failed to load resource: .* 404")
        page.reload()
        reader.says("main", reader.word("rapid.gone"))
        assert page.get_by_role("button", name=reader.word("rapid.download")).count() == 0
    finally:
        kept.write_bytes(content)
