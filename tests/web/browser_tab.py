"""A page in a real browser; its requests and console messages are checked when it closes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import Browser, ConsoleMessage, Page, Playwright

CHROMIUM = "/usr/bin/chromium"
AXE = Path(__file__).parents[1] / "foreign" / "node_modules" / "axe-core" / "axe.min.js"
PATIENCE_MS = 120_000.0
WIDE, NARROW = (1280, 800), (390, 844)
LOADING = "Loading"
READY = "main:not([aria-busy=true]):has(h1)"
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
TOKEN_KEY = "fdhil-token"
LABELS = """() => [...document.querySelectorAll("h1, h2, h3, caption, th, button, label, legend, summary, nav a")]
  .filter((e) => e.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && e.textContent.trim())
  .map((e) => `${e.tagName} ${e.textContent.trim()}`)"""
MOST_TABS = 80
# what has the focus, and whether that is seen: at the body nothing has it, the main part is only where a link leads
FOCUS = """() => {
  const at = document.activeElement, style = getComputedStyle(at);
  const label = at.getAttribute("aria-label") ?? at.labels?.[0]?.textContent ?? at.textContent;
  const drawn = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2;
  const seen = drawn || at === document.body || at.id === "main";
  return { name: label.trim(), seen, tag: at.outerHTML.slice(0, 200) };
}"""
# what stands beyond the right edge of a window that cannot be scrolled to both sides; a figure may scroll in itself
WIDER = """() => {
  const seen = document.documentElement.clientWidth;
  const scrolls = (e) => e && e !== document.documentElement
    && (/auto|scroll|hidden/.test(getComputedStyle(e).overflowX) || scrolls(e.parentElement));
  const out = [...document.querySelectorAll("body *")].filter((e) => {
    const box = e.getBoundingClientRect();
    return box.width > 1 && box.height > 1 && box.right > seen + 1 && !scrolls(e.parentElement);
  });
  const told = out.slice(0, 5).map((e) => `${e.tagName}.${e.className} ${e.textContent.trim().slice(0, 40)}`);
  return { page: document.documentElement.scrollWidth - seen, told };
}"""


def start_browser(playwright: Playwright) -> Browser:
    return playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"], timeout=PATIENCE_MS)


@dataclass
class BrowserTab:
    """A page at ``base``; ``expected`` are patterns of allowed console errors."""

    page: Page
    base: str
    asked: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("websocket", lambda opened: self.asked.append(opened.url))
        self.page.on("console", self._record_console)
        self.page.on("pageerror", lambda error: self.errors.append(f"exception: {error}"))

    def _record_console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(f"{message.type}: {message.text} ({message.location.get('url', '')})")

    def open_page(self, path: str) -> None:
        self.page.goto(self.base + path)
        self.wait_until_ready()

    def wait_until_ready(self) -> None:
        self.page.locator(READY).filter(has_not_text=LOADING).wait_for()

    def log_in(self, token: str) -> None:
        self.page.add_init_script(f"sessionStorage.setItem({TOKEN_KEY!r}, {token!r})")

    def get_text(self, key: str, **values: str) -> str:
        reported = f"import('/static/text.js').then((m) => m.t({json.dumps(key)}, {json.dumps(values)}))"
        return str(self.page.evaluate(reported))

    def wait_for_text(self, where: str, text: str) -> None:
        self.page.locator(where).filter(has_text=text).first.wait_for()

    def throttle_network(self, bytes_per_s: int, latency_ms: int = 300) -> None:
        session = self.page.context.new_cdp_session(self.page)
        session.send("Network.enable")
        bound = bytes_per_s or -1
        conditions = {"offline": False, "latency": latency_ms if bytes_per_s else 0}
        speeds = {"downloadThroughput": bound, "uploadThroughput": bound}
        session.send("Network.emulateNetworkConditions", {**conditions, **speeds})

    def focus_by_tab(self, name: str) -> None:
        """Press Tab until the button, link or field of that name has a visible focus."""
        for _ in range(MOST_TABS):
            self.page.keyboard.press("Tab")
            found = self.page.evaluate(FOCUS)
            assert found["seen"], found
            if found["name"] == name:
                return
        raise AssertionError(f"Tab does not come to {name!r}")

    def list_labels(self) -> set[str]:
        return set(self.page.evaluate(LABELS))

    def find_violations(self, *rules: str) -> list[str]:
        self.page.evaluate(
            "window.scrollTo(0, 0)"
        )  # where the page is scrolled, its sticky header hides parts of targets
        self.page.evaluate(AXE.read_text("utf-8"))
        only = {"type": "rule", "values": rules} if rules else {"type": "tag", "values": TAGS}
        options = json.dumps({"runOnly": only, "resultTypes": ["violations"]})
        found: list[dict[str, Any]] = self.page.evaluate(f"axe.run(document, {options}).then((r) => r.violations)")
        return [f"{one['id']}: {one['help']}: {[node['html'][:160] for node in one['nodes']][:4]}" for one in found]

    def find_overflow(self) -> list[str]:
        found = self.page.evaluate(WIDER)
        return [*found["told"], *([f"the page by {found['page']} px"] if found["page"] > 1 else [])]

    def find_foreign_requests(self) -> list[str]:
        home = urlsplit(self.base).netloc
        local = ("data:", "blob:", "about:")
        return [url for url in self.asked if not url.startswith(local) and urlsplit(url).netloc != home]

    def find_unexpected_messages(self) -> list[str]:
        return [error for error in self.errors if not any(re.search(known, error) for known in self.expected)]


@contextmanager
def open_tab(browser: Browser, base: str, size: tuple[int, int] = WIDE, **options: Any) -> Iterator[BrowserTab]:
    with browser.new_context(viewport={"width": size[0], "height": size[1]}, **options) as context:
        tab = BrowserTab(context.new_page(), base)
        yield tab
        tab.page.close()
    assert tab.find_foreign_requests() == []
    assert tab.find_unexpected_messages() == []
