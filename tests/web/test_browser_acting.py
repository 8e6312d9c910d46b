"""Arming in a real browser: by login and role, by keyboard, and disarming by one click."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.web.stage import PASSWORDS, Stage
from tests.web.tab import Tab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]


@pytest.fixture
def operator(stage: Stage, chromium: Browser) -> Iterator[Tab]:
    with opened(chromium, stage.url) as tab:
        tab.log_in(stage.token("operator"))
        yield tab


def log_in_by_keyboard(tab: Tab, name: str, password: str) -> None:
    tab.tab_to(tab.word("login"))
    tab.page.keyboard.press("Enter")
    tab.page.get_by_role("dialog").wait_for()
    tab.page.keyboard.type(name)
    tab.tab_to(tab.word("login.password"))
    tab.page.keyboard.type(password)
    tab.page.keyboard.press("Enter")


def choose_by_keyboard(tab: Tab) -> None:
    for label, chosen in ((tab.word("arm.program"), "corner"), (tab.word("arm.method"), "inverse")):
        tab.tab_to(label)
        tab.page.keyboard.type(chosen)


def test_a_stranger_sees_nothing_of_the_machine(stage: Stage, tab: Tab) -> None:
    for path in ("/machine", "/rapids", "/events", "/panel"):
        tab.open(path)
        tab.says("main", tab.word("login.needed"))
        assert stage.config.machine.name not in tab.page.content()
    assert {url.removeprefix(stage.url) for url in tab.asked if "/api/" in url} == {"/api/session"}
    assert tab.violations() == []


def test_a_wrong_password_is_told_and_the_dialog_stays(tab: Tab) -> None:
    tab.expected.append(r"Failed to load resource: .* 401")
    tab.open("/machine")
    log_in_by_keyboard(tab, "operator", "not the password")
    tab.says("dialog .fault", "AuthRequired")
    assert tab.violations() == []
    tab.page.keyboard.press("Escape")
    assert tab.page.get_by_role("dialog").count() == 0
    tab.says("main", tab.word("login.needed"))


def test_who_may_only_look_is_told_why_he_cannot_arm(tab: Tab) -> None:
    tab.open("/machine")
    log_in_by_keyboard(tab, "watcher", PASSWORDS["watcher"])
    tab.says("main", tab.word("arm.no.role"))
    assert tab.page.get_by_role("button", name=tab.word("arm.open")).is_disabled()


def test_a_whole_arm_and_disarm_by_the_keyboard_alone(stage: Stage, tab: Tab) -> None:
    tab.open("/machine")
    tab.page.keyboard.press("Tab")
    assert tab.page.evaluate("document.activeElement.id") == "skip"
    log_in_by_keyboard(tab, "operator", PASSWORDS["operator"])
    tab.says("#standing", tab.word("state", state="OFF"))
    tab.ready()
    stage.settled()
    tab.tab_to(tab.word("arm.open"))
    tab.page.keyboard.press("Enter")
    confirm = tab.page.get_by_role("button", name=tab.word("arm.confirm"))
    assert confirm.is_disabled()  # nothing is chosen for anybody
    choose_by_keyboard(tab)
    tab.says("#arm-plan", "corner.ngc")  # what it will move
    tab.says("#arm-predicted", "µm RMS without correction")
    assert tab.violations() == []
    assert stage.status_when(lambda told: True)["state"] == "OFF"  # it asks first
    tab.tab_to(tab.word("arm.confirm"))
    tab.page.keyboard.press("Enter")
    armed = stage.status_when(lambda told: told["state"] == "ARMED" and told["armed"])
    assert armed["armed"]["program"] == str(stage.program)
    tab.says("#standing", tab.word("state", state="ARMED"))
    tab.page.get_by_role("dialog").wait_for(state="detached")  # it has a button of that name too
    tab.tab_to(tab.word("disarm"))
    tab.page.keyboard.press("Enter")
    stage.status_when(lambda told: told["state"] == "OFF" and told["armed"] is None)
    tab.says("#standing", tab.word("state", state="OFF"))


def test_program_is_armed_on_the_page_of_its_forecast(stage: Stage, operator: Tab) -> None:
    machine, page = "section:has(#program-machine)", operator.page
    operator.open(f"/program/{stage.forecast(stage.token('operator'))}")
    operator.says(machine, operator.word("program.machine.not_armed"))
    stage.settled()
    page.get_by_role("button", name=operator.word("arm.open")).click()
    page.get_by_label(operator.word("arm.method"), exact=True).select_option("inverse")
    operator.says("#arm-predicted", "µm RMS without correction")
    page.get_by_role("button", name=operator.word("arm.confirm")).click()
    page.get_by_role("dialog").wait_for(state="detached")
    operator.says(machine, operator.word("guard.ARMED"))
    page.get_by_role("button", name=operator.word("disarm"), exact=True).click()
    operator.says(machine, operator.word("program.machine.not_armed"))


def test_what_is_asked_can_be_taken_back(stage: Stage, operator: Tab) -> None:
    operator.open("/machine")
    operator.page.get_by_role("button", name=operator.word("arm.open")).click()
    choose_by_keyboard(operator)
    operator.says("#arm-plan", "corner.ngc")
    operator.page.keyboard.press("Escape")
    assert operator.page.get_by_role("dialog").count() == 0
    assert stage.status_when(lambda told: True)["armed"] is None
    assert operator.page.evaluate("document.activeElement.id") == "arm"


@pytest.mark.parametrize(("path", "user"), [("/live", "watcher"), ("/panel", "operator")])
def test_disarm_is_one_click_on_every_page_for_all_who_may_look(
    path: str, user: str, stage: Stage, chromium: Browser
) -> None:
    with opened(chromium, stage.url) as tab:
        tab.log_in(stage.token(user))
        tab.open(path)
        stage.arm()
        tab.page.get_by_text(re.compile("ARMED")).filter(visible=True).first.wait_for()
        tab.page.get_by_role("button", name=tab.word("disarm"), exact=True).click()
        stage.status_when(lambda told: told["state"] == "OFF" and told["armed"] is None)
