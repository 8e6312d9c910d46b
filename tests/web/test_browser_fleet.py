"""The fleet page in chromium, with a real database."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import pytest

from fdhil.cli.demo.processes import ChildProcess
from tests.fleet.fleet_database import build_fleet, spread_over_days, store_records
from tests.fleet.recording_machine import RecordingMachine, write_history
from tests.fleet.servers import run_postgres
from tests.web.browser_tab import WIDE, open_tab

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ViewportSize

pytestmark = [pytest.mark.debian, pytest.mark.timeout(900)]
AT_400_PERCENT: ViewportSize = {"width": WIDE[0] // 4, "height": 256}
DAYS = 20


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("works")
    begin = datetime.now(UTC) - timedelta(days=DAYS + 1)
    with run_postgres() as database:
        for k in range(9):
            machine = RecordingMachine(
                write_history(folder / str(k), f"mill-{k}", labels={"type": "V-800", "lubricant": "ISO 68"})
            )
            for day in range(DAYS):
                worn = 0.05 * day if k == 2 else 0.8 if k == 4 else 0.001 * ((day * k) % 5)
                machine.record_windows(1, parameters={"ft": 0.05 * (1 + worn)})
            machine.close_store()
            asyncio.run(store_records(build_fleet(database, folder), spread_over_days(machine, begin)))
        file = folder / "fleet.toml"
        file.write_text(f'[database]\nconnection = "{database.connection}"\n')
        web = ChildProcess("web", ["fdhil", "fleet", "web", "--port", "0", "--json", str(file)], folder / "web.log")
        yield str(web.await_event("ready")["url"]).rstrip("/")
        assert web.stop() == 0


@pytest.mark.parametrize("path", ["/fleet", "/fleet/mill-2/X"])
def test_fleet_page_is_accessible(path: str, url: str, chromium_browser: Browser) -> None:
    with open_tab(chromium_browser, url) as tab:
        tab.page.emulate_media(reduced_motion="reduce")
        tab.open_page(path)
        assert tab.page.locator("h1").count() == 1
        assert (tab.find_overflow(), tab.find_violations()) == ([], [])
        wide = tab.list_labels()
        tab.page.emulate_media(color_scheme="dark")
        assert tab.find_violations("color-contrast") == []
        tab.page.set_viewport_size(AT_400_PERCENT)
        assert wide - tab.list_labels() == set()
        assert tab.find_overflow() == []


def test_due_and_outlying_axes_link_to_their_axis(url: str, chromium_browser: Browser) -> None:
    with open_tab(chromium_browser, url) as tab:
        tab.open_page("/")
        tab.wait_for_text("section:has(h2:text-is('Due')) tr", "mill-2, axis X")
        tab.wait_for_text("section:has(h2:text-is('Different from their peers')) tr", "+8")
        tab.page.get_by_label("Peers have the same").select_option("lubricant")
        tab.wait_for_text("section:has(h2:text-is('Different from their peers')) tr", "mill-4, axis X")
        tab.page.locator("section:has(h2:text-is('Due')) a", has_text="mill-2, axis X").first.click()
        tab.wait_for_text("h1", "mill-2, axis X")
        tab.page.locator(".chart .plot canvas").nth(5).wait_for()
        assert tab.page.locator(".chart").count() == 6
        assert [url for url in tab.asked if "/api/machine" in url] == []
