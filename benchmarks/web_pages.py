"""How long the pages of ``fdhil web`` take in chromium, from the wish to see one to its content.

python -m benchmarks.web_pages [TIMES]
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

from tests.web import browser_tab, web_rig

RAPIDS = 168  # of each axis: twelve weeks
TIMES = 3
# content is there once the page's script has ended its first work and nothing says that it is loading
NOTE = """(() => {
  const there = () => {
    const main = document.querySelector("%s");
    if (globalThis.contentAfterMs === undefined && main && !main.textContent.includes("%s")) {
      globalThis.contentAfterMs = performance.now();
    }
  };
  new MutationObserver(there).observe(document, { subtree: true, childList: true, attributes: true });
})()"""
TAKEN = """() => {
  const loaded = [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")];
  return { requests: loaded.length, bytes: loaded.reduce((sum, one) => sum + one.transferSize, 0) };
}"""


def main() -> None:
    """Open each page so often with an empty cache, and as often again with a full one; print the medians."""
    times = int(sys.argv[1]) if len(sys.argv) > 1 else TIMES
    with tempfile.TemporaryDirectory() as folder, web_rig.open_rig(Path(folder), RAPIDS) as machine:
        token = machine.log_in_for_token("operator")
        paths = machine.list_paths(token)
        with sync_playwright() as playwright:
            browser = browser_tab.start_browser(playwright)
            print("page        first visit, ms   again, ms   largest, ms   requests   kB")
            for name, path in paths.items():
                found = [_visits(browser, machine.url, path, token) for _ in range(times)]
                print(_line(name, found))
            browser.close()


def _visits(browser: Browser, base: str, path: str, token: str) -> list[dict[str, Any]]:
    """Return what the first visit of a new browser took, and what the second did."""
    with browser_tab.open_tab(browser, base) as shown:
        shown.log_in(token)
        shown.page.add_init_script(NOTE % (browser_tab.READY, browser_tab.LOADING))
        return [_visit(shown, path) for _ in range(2)]


def _visit(shown: browser_tab.BrowserTab, path: str) -> dict[str, Any]:
    shown.open_page(path)
    taken: dict[str, Any] = shown.page.evaluate(TAKEN)
    return {**taken, "ms": shown.page.evaluate("contentAfterMs")}


def _line(name: str, found: list[list[dict[str, Any]]]) -> str:
    first, again = ([visits[k]["ms"] for visits in found] for k in (0, 1))
    size = found[0][0]
    largest = max(*first, *again)
    return (
        f"{name:<11} {statistics.median(first):12.0f} {statistics.median(again):14.0f} {largest:13.0f}"
        f" {size['requests']:10d} {size['bytes'] / 1e3:4.0f}"
    )


if __name__ == "__main__":
    main()
