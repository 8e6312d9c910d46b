"""A page in a real browser: charts become interactive, zoom, hide curves; and the page prints."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdhil.report import Page, Section, Table, figures, find_browser, path_maps, render_html, write_pdf
from fdhil.report.pdf import run_browser
from tests.report.test_report_page import PARAMETERS, build_window, extract_curves

pytestmark = pytest.mark.debian

USED = """<script>
const picture = document.querySelectorAll("figure")[1].querySelector("svg"), place = picture.getBoundingClientRect();
picture.setPointerCapture = () => {};
function at(kind, x, y) {
  const where = { clientX: place.left + x, clientY: place.top + y, pointerId: 1 };
  picture.dispatchEvent(new PointerEvent(kind, where));
}
at("pointerdown", 100, 100); at("pointermove", 200, 150); at("pointerup", 200, 150);
document.querySelectorAll("figure")[2].querySelector('[id*="-legend-1"]').dispatchEvent(new MouseEvent("click"));
</script></body>"""


def build_page() -> Page:
    """Return a page with one picture of each kind: a chart of two panels, a map, an enlarged detail."""
    path = extract_curves()[0].path_mm
    pictures = [
        ("model", figures.draw_model_comparison(build_window(), PARAMETERS, 99.5)),
        ("map", path_maps.draw_error_map(path, np.linspace(0, 9, 200), 9.0)),
        ("corner", figures.draw_path_detail(extract_curves(), (5.0, 5.0), 1.0)),
    ]
    rows = [[str(k), f"{k} um"] for k in range(80)]
    return Page(
        "A page", "subtitle", [("after", "3.5 um")], [Section("One", "text", [Table(["a", "b"], rows)], pictures)]
    )


def render_in_browser(text: str, folder: Path) -> str:
    """Return the browser's document after its scripts ran."""
    source, found = folder / "page.html", folder / "dom.html"
    source.write_text(text, "utf-8")
    with found.open("w") as file:
        run_browser(find_browser(), folder, "--dump-dom", "--virtual-time-budget=2000", source.as_uri(), output=file)
    return found.read_text("utf-8")


def test_charts_become_interactive_in_the_browser(tmp_path: Path) -> None:
    document = render_in_browser(render_html(build_page()).replace("</body>", USED), tmp_path)
    assert document.count('class="uplot') == 2
    assert len(re.findall(r'<svg[^>]*class="still"', document)) == 1
    (reading,) = re.findall(r"<output>(X [^<]*)</output>", document)
    assert re.fullmatch(r"X \d\.\d\d mm, Y \d\.\d\d mm: [\d.]+ µm", reading)
    assert len(re.findall(r'<svg[^>]*class="zoomed"', document)) == 1
    assert re.search(r'<g id="[^"]*trace-1" class="off"', document)


def test_printed_page_contains_the_static_pictures(tmp_path: Path) -> None:
    whole = build_page()
    (section,) = whole.sections
    lines = replace(section, figures=[section.figures[0], section.figures[2]])  # a colour scale is an image
    write_pdf(replace(whole, sections=[lines]), tmp_path / "page.pdf")
    printed = (tmp_path / "page.pdf").read_bytes()
    assert printed.startswith(b"%PDF")
    assert 2 <= len(re.findall(rb"/Type /Page\b", printed)) <= 4
    assert b"/Subtype /Image" not in printed  # vector curves and text, not a screenshot
