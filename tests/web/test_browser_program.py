"""A program judged in a browser: dropped, examined by wheel, pinch and keys, opened by address; and the panel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

from tests.web.stage import Stage
from tests.web.tab import NARROW, PATIENCE_MS, Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FilePayload

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
PANEL = (400, 300)
LOOK_MS = 100
HEIGHT = "(document.querySelector('.tab') ?? document.querySelector('main')).scrollHeight"


@pytest.fixture(scope="module")
def token(stage: Stage) -> str:
    return stage.token("watcher")


@pytest.fixture(params=[(1280, 800), NARROW], ids=["wide", "narrow"])
def judged(request: pytest.FixtureRequest, stage: Stage, chromium: Browser, token: str) -> Iterator[Tab]:
    with opened(chromium, stage.url, request.param, has_touch=True) as tab:
        tab.log_in(token)
        tab.open("/program")
        tab.page.set_input_files("#program-file", str(stage.program))
        tab.page.locator("canvas.map").first.wait_for()
        tab.page.locator(".listing li").first.wait_for()
        yield tab


def seen(tab: Tab) -> Any:
    return tab.page.evaluate("[...document.querySelectorAll('canvas.map')].map((map) => map.toDataURL())")


def changed(tab: Tab, before: Any) -> None:
    for _ in range(round(PATIENCE_MS / LOOK_MS)):
        if all(now != then for now, then in zip(seen(tab), before, strict=True)):
            return
        tab.page.wait_for_timeout(LOOK_MS)
    raise AssertionError("the maps stay as they are")


def test_a_corner_is_looked_at_by_wheel_pinch_and_keys(judged: Tab) -> None:
    page = judged.page
    assert judged.violations() == []
    assert judged.wider() == []
    page.get_by_role("button", name="Show X").first.click()
    judged.says("dl.readout", "line")
    page.wait_for_url("**?line=4")
    assert page.locator(".listing [aria-current]").inner_text().split() == ["4", "G1", "Y40"]
    judged.says("main", "Dashed: predicted table path")
    for key in ("+", "Shift+ArrowLeft", "-", "0"):
        before = seen(judged)
        page.locator("canvas.map").first.press(key)
        changed(judged, before)
    page.locator("canvas.map").first.press("ArrowUp")
    page.wait_for_url("**?line=3")
    before = seen(judged)
    box = page.locator("canvas.map").first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.wheel(0, -400)
    changed(judged, before)
    before = seen(judged)
    pinch(judged, x, y)
    changed(judged, before)
    before = seen(judged)
    page.emulate_media(color_scheme="dark")
    changed(judged, before)
    assert judged.violations("color-contrast") == []


def pinch(tab: Tab, x: float, y: float) -> None:
    session = tab.page.context.new_cdp_session(tab.page)
    for kind, apart in (("touchStart", 20), ("touchMove", 40), ("touchMove", 80), ("touchEnd", 0)):
        points = [{"x": x + apart, "y": y, "id": 1}, {"x": x - apart, "y": y, "id": 2}] if apart else []
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def test_an_address_leads_to_a_line(judged: Tab, stage: Stage, chromium: Browser, token: str) -> None:
    with opened(chromium, stage.url) as other:
        other.log_in(token)
        path = judged.page.url.removeprefix(stage.url).partition("?")[0]
        other.open(f"{path}?line=4")
        other.says(".listing [aria-current]", "G1 Y40")
        other.says("dl.readout", "mm/min")


def test_a_faulty_program_is_told_with_what_to_do(stage: Stage, chromium: Browser, token: str) -> None:
    with opened(chromium, stage.url) as tab:
        tab.log_in(token)
        tab.open("/program")
        faulty: FilePayload = {"name": "bad.ngc", "mimeType": "text/plain", "buffer": b"G21 G90\nG1 X1..5 F100\n"}
        tab.page.set_input_files("#program-file", faulty)
        tab.says(".fault", "line 2")
        tab.says(".fault", "drop it again")


def test_the_panel_fits_a_tab_of_an_nc(stage: Stage, chromium: Browser) -> None:
    with opened(chromium, stage.url, PANEL) as tab:
        tab.log_in(stage.token("operator"))
        tab.open("/panel")
        tab.says(".tab", "Nothing is armed")
        assert tab.page.evaluate(HEIGHT) <= PANEL[1]
        assert tab.page.evaluate("document.querySelector('.scroll').scrollWidth") <= PANEL[0]
        assert tab.wider() == []
        assert tab.violations() == []
        tab.page.get_by_role("button", name="Disarm").click()
        tab.says(".tab", "Disarmed")
