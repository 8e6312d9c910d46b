"""Draw the pages of ``fdhil web`` as a browser shows them, in front of a simulated machine with weeks of history.

PYTHONPATH=. python docs/images/web.py [PAGE...]
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from tests.web import browser_tab, web_rig

IMAGES = Path(__file__).parent
RAPIDS = 84  # of each axis: six weeks
TO_AND_FRO = "G21 G90 G94\n" + "G0 X200 Y200\nG4 P0.3\nG0 X0 Y0\nG4 P0.3\n" * 4 + "M2\n"
COLOURS = 128
TALLEST = {"wide": 1500, "narrow": 1400}  # px: what goes on below is more of the same
SIZES = {"wide": (1280, 800), "narrow": browser_tab.NARROW}
EMBEDDED = (400, 300)  # px, as in a tab of LinuxCNC
PAGES = ("machine", "live", "rapids", "rapid", "history", "forecast", "events")
IN_THE_DARK = ("machine", "rapid")
CALM_MS = 1500.0  # for what is drawn after the content came


def main() -> None:
    """Draw those pages that are named, or all."""
    wanted = sys.argv[1:] or [*PAGES, "panel"]
    with tempfile.TemporaryDirectory() as folder, web_rig.open_rig(Path(folder), RAPIDS) as machine:
        token = machine.log_in_for_token("operator")
        paths = machine.list_paths(token)
        program = machine.folder / "shuttle.ngc"
        program.write_text(TO_AND_FRO)
        machine.play_program(program)
        with sync_playwright() as playwright:
            browser = browser_tab.start_browser(playwright)
            for name in wanted:
                draw(browser, machine, token, name, paths[name], program)
            browser.close()


def draw(browser: Browser, machine: web_rig.WebRig, token: str, name: str, path: str, program: Path) -> None:
    """Draw one page in each size, and in the dark where that tells more."""
    looks = [("narrow", EMBEDDED, "light")] if name == "panel" else [(k, size, "light") for k, size in SIZES.items()]
    looks += [("dark", SIZES["wide"], "dark")] if name in IN_THE_DARK else []
    for label, size, scheme in looks:
        with shown(browser, machine.url, token, path, size, scheme) as page:
            if name == "live":
                machine.play_program(program)
            page.wait_for_timeout(CALM_MS)
            taken = page.screenshot(full_page=name != "panel")
            save(taken, IMAGES / f"web-{name}-{label}.png", TALLEST.get(label, TALLEST["wide"]))


@contextmanager
def shown(browser: Browser, base: str, token: str, path: str, size: tuple[int, int], scheme: str) -> Iterator[Page]:
    """Open a page with that login, in a window of that size."""
    with browser_tab.open_tab(browser, base, size, color_scheme=scheme, reduced_motion="reduce") as opened:
        opened.log_in(token)
        opened.open_page(path)
        yield opened.page


def save(taken: bytes, file: Path, tallest: int) -> None:
    """Write a picture with few colours, cut below."""
    image = Image.open(io.BytesIO(taken)).convert("RGB")
    image = image.crop((0, 0, image.width, min(image.height, tallest)))
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(file, optimize=True)


if __name__ == "__main__":
    main()
