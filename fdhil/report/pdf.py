"""Prints a page as PDF with the browser of this computer."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import IO

from fdhil.child_process import wrap_to_end_with_parent
from fdhil.errors import FdhilError
from fdhil.report.report_page import Page, render_html, write_page
from fdhil.store import open_output

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "microsoft-edge", "brave-browser")
LONGEST_S = 120.0  # a start from a cold disk takes several seconds
SWITCHES = (
    "--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--disable-background-networking",
    "--disable-component-update", "--no-pdf-header-footer", "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip
MISSING = (
    "a PDF needs a browser to print it, and none is installed: install one (apt-get install chromium), or write the "
    "HTML page, open it on another computer and print it there"
)


def write_page_or_pdf(page: Page, html_file: Path | None, pdf_file: Path | None) -> None:
    """Write the page to the requested files. FdhilError or OutputError."""
    if html_file is not None:
        write_page(page, html_file)
    if pdf_file is not None:
        write_pdf(page, pdf_file)


def find_browser() -> str:
    """Return the browser's path; FdhilError without one."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise FdhilError(MISSING)
    return found


def write_pdf(page: Page, path: Path) -> None:
    """Print ``page`` to ``path``, A4, atomically. FdhilError without a browser or when it prints nothing."""
    browser = find_browser()
    with tempfile.TemporaryDirectory(prefix="fdhil-pdf-") as name:
        folder = Path(name)
        source, printed = folder / "page.html", folder / "page.pdf"
        source.write_text(render_html(page), "utf-8")
        message = run_browser(browser, folder, f"--print-to-pdf={printed}", source.as_uri())
        if not printed.is_file():
            raise FdhilError(f"{browser} printed nothing ({message}); print the HTML page from a browser instead")
        with open_output(path) as file:
            file.write(printed.read_bytes())


def run_browser(browser: str, folder: Path, *arguments: str, output: IO[str] | None = None) -> str:
    """Run the browser with its own profile below ``folder``; return its last message. FdhilError when it hangs.

    ``output`` receives what it prints.
    """
    # the browser's sandbox needs a non-root user; it opens only a page written here
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    command = [browser, *SWITCHES, *sandbox, f"--user-data-dir={folder / 'profile'}", *arguments]
    try:
        ended = subprocess.run(
            wrap_to_end_with_parent(command),
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
        raise FdhilError(f"{browser} cannot be started: {error.strerror}; reinstall it") from None
    lines = ended.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit {ended.returncode}"
