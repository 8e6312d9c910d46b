"""Prints a page as PDF with the browser of this computer: a browser sets tables and text better than we would."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import IO

from fdhil.child import ending_with_parent
from fdhil.errors import FdhilError
from fdhil.report.page import Page, html, write
from fdhil.store.output import open_output

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge", "brave-browser")
LONGEST_S = 120.0  # a start from a cold disk takes some seconds
SWITCHES = (
    "--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--disable-background-networking",
    "--disable-component-update", "--no-pdf-header-footer", "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip
MISSING = (
    "a PDF is printed by a browser, and there is none here: install one (apt-get install chromium), or write the HTML "
    "page, open it on any computer and print it there"
)


def deliver(page: Page, html_file: Path | None, pdf_file: Path | None) -> None:
    """Write the page to the files that were asked for. FdhilError as :func:`write` and :func:`write_pdf` raise it."""
    if html_file is not None:
        write(page, html_file)
    if pdf_file is not None:
        write_pdf(page, pdf_file)


def find_browser() -> str:
    """Return the browser's path; FdhilError where there is none."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise FdhilError(MISSING)
    return found


def write_pdf(page: Page, path: Path) -> None:
    """Print ``page`` to ``path``, A4, whole or not at all. FdhilError without a browser or when it prints nothing."""
    browser = find_browser()
    with tempfile.TemporaryDirectory(prefix="fdhil-pdf-") as name:
        folder = Path(name)
        source, printed = folder / "page.html", folder / "page.pdf"
        source.write_text(html(page), "utf-8")
        told = run_browser(browser, folder, f"--print-to-pdf={printed}", source.as_uri())
        if not printed.is_file():
            raise FdhilError(f"{browser} printed nothing ({told}); print the HTML page from a browser instead")
        with open_output(path) as file:
            file.write(printed.read_bytes())


def run_browser(browser: str, folder: Path, *arguments: str, output: IO[str] | None = None) -> str:
    """Run the browser with a profile of its own below ``folder``; return the last it said. FdhilError when it hangs.

    ``output`` gets what it prints.
    """
    # the browser's own sandbox needs a user that is not root; what it opens is a page that we wrote
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    command = [browser, *SWITCHES, *sandbox, f"--user-data-dir={folder / 'profile'}", *arguments]
    try:
        ended = subprocess.run(
            ending_with_parent(command),
            stdout=output or subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=LONGEST_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        text = f"{browser} did not print within {LONGEST_S:.0f} s; print the HTML page from a browser instead"
        raise FdhilError(text) from None
    except OSError as error:
        raise FdhilError(f"{browser} cannot be started: {error.strerror}; install it anew") from None
    said = ended.stderr.strip().splitlines()
    return said[-1] if said else f"exit {ended.returncode}"
