"""A program judged in a browser: dropped, examined by wheel, pinch and keys, opened by address; and the panel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

from tests.web.browser_tab import NARROW, PATIENCE_MS, BrowserTab, open_tab
from tests.web.web_rig import WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FilePayload

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
PANEL = (400, 300)
LOOK_MS = 100
HEIGHT = "(document.querySelector('.tab') ?? document.querySelector('main')).scrollHeight"


@pytest.fixture(scope="module")
def token(web_rig: WebRig) -> str:
    return web_rig.log_in_for_token("watcher")


@pytest.fixture(params=[(1280, 800), NARROW], ids=["wide", "narrow"])
def judged(
    request: pytest.FixtureRequest, web_rig: WebRig, chromium_browser: Browser, token: str
) -> Iterator[BrowserTab]:
    with open_tab(chromium_browser, web_rig.url, request.param, has_touch=True) as tab:
        tab.log_in(token)
        tab.open_page("/program")
        tab.page.set_input_files("#program-file", str(web_rig.program))
        tab.page.locator("canvas.map").first.wait_for()
        tab.page.locator(".listing li").first.wait_for()
        yield tab


def read_map(tab: BrowserTab) -> Any:
    return tab.page.evaluate("[...document.querySelectorAll('canvas.map')].map((map) => map.toDataURL())")


def wait_for_change(tab: BrowserTab, before: Any) -> None:
    for _ in range(round(PATIENCE_MS / LOOK_MS)):
        if all(now != then for now, then in zip(read_map(tab), before, strict=True)):
            return
        tab.page.wait_for_timeout(LOOK_MS)
    raise AssertionError("the maps stay as they are")


def test_corner_is_zoomed_by_wheel_pinch_and_keys(judged: BrowserTab) -> None:
    page = judged.page
    assert judged.find_violations() == []
    assert judged.find_overflow() == []
    page.get_by_role("button", name="Show X").first.click()
    judged.wait_for_text("dl.readout", "line")
    page.wait_for_url("**?line=4")
    assert page.locator(".listing [aria-current]").inner_text().split() == ["4", "G1", "Y40"]
    judged.wait_for_text("main", "Dashed: predicted table path")
    for key in ("+", "Shift+ArrowLeft", "-", "0"):
        before = read_map(judged)
        page.locator("canvas.map").first.press(key)
        wait_for_change(judged, before)
    page.locator("canvas.map").first.press("ArrowUp")
    page.wait_for_url("**?line=3")
    before = read_map(judged)
    box = page.locator("canvas.map").first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.wheel(0, -400)
    wait_for_change(judged, before)
    before = read_map(judged)
    pinch(judged, x, y)
    wait_for_change(judged, before)
    before = read_map(judged)
    page.emulate_media(color_scheme="dark")
    wait_for_change(judged, before)
    assert judged.find_violations("color-contrast") == []


def pinch(tab: BrowserTab, x: float, y: float) -> None:
    session = tab.page.context.new_cdp_session(tab.page)
    for kind, apart in (("touchStart", 20), ("touchMove", 40), ("touchMove", 80), ("touchEnd", 0)):
        points = [{"x": x + apart, "y": y, "id": 1}, {"x": x - apart, "y": y, "id": 2}] if apart else []
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_address_selects_a_line(judged: BrowserTab, web_rig: WebRig, chromium_browser: Browser, token: str) -> None:
    with open_tab(chromium_browser, web_rig.url) as other:
        other.log_in(token)
        path = judged.page.url.removeprefix(web_rig.url).partition("?")[0]
        other.open_page(f"{path}?line=4")
        other.wait_for_text(".listing [aria-current]", "G1 Y40")
        other.wait_for_text("dl.readout", "mm/min")


def test_faulty_program_is_reported_with_action(web_rig: WebRig, chromium_browser: Browser, token: str) -> None:
    with open_tab(chromium_browser, web_rig.url) as tab:
        tab.log_in(token)
        tab.open_page("/program")
        faulty: FilePayload = {"name": "bad.ngc", "mimeType": "text/plain", "buffer": b"G21 G90\nG1 X1..5 F100\n"}
        tab.page.set_input_files("#program-file", faulty)
        tab.wait_for_text(".fault", "line 2")
        tab.wait_for_text(".fault", "drop it again")


def test_panel_fits_into_nc_tab(web_rig: WebRig, chromium_browser: Browser) -> None:
    with open_tab(chromium_browser, web_rig.url, PANEL) as tab:
        tab.log_in(web_rig.log_in_for_token("operator"))
        tab.open_page("/panel")
        tab.wait_for_text(".tab", "Nothing is armed")
        assert tab.page.evaluate(HEIGHT) <= PANEL[1]
        assert tab.page.evaluate("document.querySelector('.scroll').scrollWidth") <= PANEL[0]
        assert tab.find_overflow() == []
        assert tab.find_violations() == []
        tab.page.get_by_role("button", name="Disarm").click()
        tab.wait_for_text(".tab", "Disarmed")
