"""Arming in a real browser: by login and role, by keyboard, and disarming by one click."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.web.browser_tab import BrowserTab, open_tab
from tests.web.web_rig import PASSWORDS, WebRig

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]


@pytest.fixture
def operator(web_rig: WebRig, chromium_browser: Browser) -> Iterator[BrowserTab]:
    with open_tab(chromium_browser, web_rig.url) as tab:
        tab.log_in(web_rig.log_in_for_token("operator"))
        yield tab


def log_in_by_keyboard(tab: BrowserTab, name: str, password: str) -> None:
    tab.focus_by_tab(tab.get_text("login"))
    tab.page.keyboard.press("Enter")
    tab.page.get_by_role("dialog").wait_for()
    tab.page.keyboard.type(name)
    tab.focus_by_tab(tab.get_text("login.password"))
    tab.page.keyboard.type(password)
    tab.page.keyboard.press("Enter")


def choose_by_keyboard(tab: BrowserTab) -> None:
    for label, chosen in ((tab.get_text("arm.program"), "corner"), (tab.get_text("arm.method"), "inverse")):
        tab.focus_by_tab(label)
        tab.page.keyboard.type(chosen)


def test_page_without_login_shows_nothing_of_the_machine(web_rig: WebRig, browser_tab: BrowserTab) -> None:
    for path in ("/machine", "/rapids", "/events", "/panel"):
        browser_tab.open_page(path)
        browser_tab.wait_for_text("main", browser_tab.get_text("login.needed"))
        assert web_rig.config.machine.name not in browser_tab.page.content()
    assert {url.removeprefix(web_rig.url) for url in browser_tab.asked if "/api/" in url} == {"/api/session"}
    assert browser_tab.find_violations() == []


def test_wrong_password_is_reported_in_open_dialog(browser_tab: BrowserTab) -> None:
    browser_tab.expected.append(r"Failed to load resource: .* 401")
    browser_tab.open_page("/machine")
    log_in_by_keyboard(browser_tab, "operator", "not the password")
    browser_tab.wait_for_text("dialog .fault", "AuthRequired")
    assert browser_tab.find_violations() == []
    browser_tab.page.keyboard.press("Escape")
    assert browser_tab.page.get_by_role("dialog").count() == 0
    browser_tab.wait_for_text("main", browser_tab.get_text("login.needed"))


def test_watcher_sees_why_arming_is_refused(browser_tab: BrowserTab) -> None:
    browser_tab.open_page("/machine")
    log_in_by_keyboard(browser_tab, "watcher", PASSWORDS["watcher"])
    browser_tab.wait_for_text("main", browser_tab.get_text("arm.no.role"))
    assert browser_tab.page.get_by_role("button", name=browser_tab.get_text("arm.open")).is_disabled()


def test_arm_and_disarm_by_keyboard(web_rig: WebRig, browser_tab: BrowserTab) -> None:
    browser_tab.open_page("/machine")
    browser_tab.page.keyboard.press("Tab")
    assert browser_tab.page.evaluate("document.activeElement.id") == "skip"
    log_in_by_keyboard(browser_tab, "operator", PASSWORDS["operator"])
    browser_tab.wait_for_text("#standing", browser_tab.get_text("state", state="OFF"))
    browser_tab.wait_until_ready()
    web_rig.wait_until_settled()
    browser_tab.focus_by_tab(browser_tab.get_text("arm.open"))
    browser_tab.page.keyboard.press("Enter")
    confirm = browser_tab.page.get_by_role("button", name=browser_tab.get_text("arm.confirm"))
    assert confirm.is_disabled()  # nothing is chosen for anybody
    choose_by_keyboard(browser_tab)
    browser_tab.wait_for_text("#arm-plan", "corner.ngc")  # what it will move
    browser_tab.wait_for_text("#arm-predicted", "µm RMS without correction")
    assert browser_tab.find_violations() == []
    assert web_rig.wait_for_status(lambda told: True)["state"] == "OFF"  # it asks first
    browser_tab.focus_by_tab(browser_tab.get_text("arm.confirm"))
    browser_tab.page.keyboard.press("Enter")
    armed = web_rig.wait_for_status(lambda told: told["state"] == "ARMED" and told["armed"])
    assert armed["armed"]["program"] == str(web_rig.program)
    browser_tab.wait_for_text("#standing", browser_tab.get_text("state", state="ARMED"))
    browser_tab.page.get_by_role("dialog").wait_for(state="detached")  # it has a button of that name too
    browser_tab.focus_by_tab(browser_tab.get_text("disarm"))
    browser_tab.page.keyboard.press("Enter")
    web_rig.wait_for_status(lambda told: told["state"] == "OFF" and told["armed"] is None)
    browser_tab.wait_for_text("#standing", browser_tab.get_text("state", state="OFF"))


def test_program_is_armed_on_the_page_of_its_forecast(web_rig: WebRig, operator: BrowserTab) -> None:
    machine, page = "section:has(#program-machine)", operator.page
    operator.open_page(f"/program/{web_rig.forecast_program(web_rig.log_in_for_token('operator'))}")
    operator.wait_for_text(machine, operator.get_text("program.machine.not_armed"))
    web_rig.wait_until_settled()
    page.get_by_role("button", name=operator.get_text("arm.open")).click()
    page.get_by_label(operator.get_text("arm.method"), exact=True).select_option("inverse")
    operator.wait_for_text("#arm-predicted", "µm RMS without correction")
    page.get_by_role("button", name=operator.get_text("arm.confirm")).click()
    page.get_by_role("dialog").wait_for(state="detached")
    operator.wait_for_text(machine, operator.get_text("guard.ARMED"))
    page.get_by_role("button", name=operator.get_text("disarm"), exact=True).click()
    operator.wait_for_text(machine, operator.get_text("program.machine.not_armed"))


def test_arming_request_can_be_cancelled(web_rig: WebRig, operator: BrowserTab) -> None:
    operator.open_page("/machine")
    operator.page.get_by_role("button", name=operator.get_text("arm.open")).click()
    choose_by_keyboard(operator)
    operator.wait_for_text("#arm-plan", "corner.ngc")
    operator.page.keyboard.press("Escape")
    assert operator.page.get_by_role("dialog").count() == 0
    assert web_rig.wait_for_status(lambda told: True)["armed"] is None
    assert operator.page.evaluate("document.activeElement.id") == "arm"


@pytest.mark.parametrize(("path", "user"), [("/live", "watcher"), ("/panel", "operator")])
def test_every_page_has_disarm_button_for_every_user(
    path: str, user: str, web_rig: WebRig, chromium_browser: Browser
) -> None:
    with open_tab(chromium_browser, web_rig.url) as tab:
        tab.log_in(web_rig.log_in_for_token(user))
        tab.open_page(path)
        web_rig.arm_program()
        tab.page.get_by_text(re.compile("ARMED")).filter(visible=True).first.wait_for()
        tab.page.get_by_role("button", name=tab.get_text("disarm"), exact=True).click()
        web_rig.wait_for_status(lambda told: told["state"] == "OFF" and told["armed"] is None)
